"""Whatever is installed with the package has a licence that docs/licences.md says."""

import importlib.metadata
import re
import tomllib

import pytest

from sliceit_drake.resources import resource_path

ROOT = resource_path("scenarios").parent
KINDS = ("BSD", "MIT", "Apache", "PSF", "Python Software Foundation", "MPL", "LGPL")


def declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    return sorted({re.match(r"[\w.-]+", entry)[0] for group in groups for entry in group})


def page():
    rows = re.findall(
        r"^\| ([\w.,_ -]+) \| .* \| (.*) \|$", (ROOT / "docs/licences.md").read_text(), re.M
    )
    return {name.strip(): licence for names, licence in rows for name in names.split(",")}


def said(name):
    """Kinds of licence that an installed package names."""
    facts = importlib.metadata.metadata(name)
    classifiers = [c for c in facts.get_all("Classifier") or [] if c.startswith("License")]
    text = " ".join(
        [facts.get("License-Expression") or "", facts.get("License") or "", *classifiers]
    )
    return {kind for kind in KINDS if kind in text}


def test_each_dependency_stands_on_the_page():
    assert set(declared()) <= set(page())
    assert set(page()) - set(declared()) <= {"package"}


@pytest.mark.parametrize("name", declared())
def test_the_page_says_what_the_package_says(name):
    try:
        kinds = said(name)
    except importlib.metadata.PackageNotFoundError:
        pytest.skip(f"{name} is not installed")
    licence = page()[name]
    assert any(kind in licence for kind in KINDS), licence
    if kinds:
        wanted = {"PSF" if kind == "Python Software Foundation" else kind for kind in kinds}
        assert any(kind in licence for kind in wanted), (licence, kinds)
