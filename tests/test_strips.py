"""Strips hold each tetrahedron once, as four nodes in a row, and leave few places empty."""

import numpy as np
import pytest

from sliceit_drake.cutting.kernels.types import CORNERS, STRIP
from sliceit_drake.cutting.mesh.generators import box_mesh, cylinder_mesh, ellipsoid_mesh
from sliceit_drake.cutting.mesh.strips import tetrahedron_strips
from sliceit_drake.cutting.mesh.tetrahedra import TetrahedralMesh

GRID = np.linspace(-1.0, 1.0, 6)
MESHES = {
    "box": box_mesh(GRID, GRID, GRID),
    "cylinder": cylinder_mesh(0.04, np.linspace(0.0, 0.03, 5), 3),
    "ellipsoid": ellipsoid_mesh((0.05, 0.04, 0.03), 2),
}


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)
def test_each_tetrahedron_is_four_nodes_in_a_row_of_one_strip(mesh: TetrahedralMesh):
    nodes, place = tetrahedron_strips(mesh.tetrahedra)
    assert nodes.shape == (len(nodes), CORNERS)
    assert len(np.unique(place)) == len(mesh.tetrahedra)
    strip, k = np.divmod(place, STRIP)
    found = nodes[strip[:, None], k[:, None] + np.arange(4)]
    assert (np.sort(found, axis=1) == np.sort(mesh.tetrahedra, axis=1)).all()


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)
def test_strips_are_full_but_for_a_few(mesh: TetrahedralMesh):
    nodes, place = tetrahedron_strips(mesh.tetrahedra)
    assert len(place) > 0.95 * STRIP * len(nodes)
    # What fills a short strip up is a tetrahedron too.
    for k in range(STRIP):
        window = np.sort(nodes[:, k : k + 4], axis=1)
        assert (np.diff(window, axis=1) > 0).all()


def test_tetrahedra_that_share_no_face_are_strips_of_their_own():
    nodes, place = tetrahedron_strips(np.array([[0, 1, 2, 3], [3, 4, 5, 6]]))
    assert place.tolist() == [0, STRIP]
    assert nodes.tolist() == [[0, 1, 2, 3, 0, 1], [3, 4, 5, 6, 3, 4]]
