"""What DiSECt sets, and where it is set here."""

__all__ = ["SETTINGS"]

SETTINGS: tuple[tuple[str, str, str], ...] = (
    (
        "Young's modulus, Poisson's ratio",
        "2.6 MPa, 0.37",
        "`food.material.youngs_modulus`, `food.material.poisson_ratio`; its entered pair "
        "behaves like 1.955 MPa, 0.374 (`small_strain_moduli`)",
    ),
    (
        "density",
        "950 kg/m3",
        "`food.material.density`",
    ),
    (
        "damping of the elements",
        "10 Pa s",
        "`food.material.damping_time`: viscosity over E",
    ),
    (
        "triangle elasticity",
        "off",
        "no counterpart, because a membrane's stiffness is not seen in a cut; what a skin costs"
        " to cut is `food.effects.skin.toughness`",
    ),
    (
        "gravity",
        "9.80665 m/s2",
        "no counterpart, because it is 9.81 m/s2 here; its direction follows the board",
    ),
    (
        "grid: cells and their size",
        "9 x 5 x 6 of 6 mm",
        "`food.shape.size`, `food.shape.divisions`, `food.shape.layers`",
    ),
    (
        "mesh file and its scale",
        "",
        "`food.shape.path`, `food.shape.scale`",
    ),
    (
        "place and orientation of the object",
        "",
        "`food.cut_point`, `food.cut_normal`: the cut is placed in the food",
    ),
    (
        "boxes of vertices that are held",
        "all farther than 10 mm",
        "`food.hold_distance`, `food.held_sides`; other regions have no counterpart, because "
        "what is far from the cut is held and what is near must move",
    ),
    (
        "surface of the cut: swept edge, 50 steps",
        "a plane",
        "`food.cut_point`, `food.cut_normal`; a curved sweep has no counterpart, because the "
        "cut is a plane here",
    ),
    (
        "cut spring stiffness",
        "200 N/m",
        "`numerics.bond_stiffness`, per area: 2.1e7 Pa/m",
    ),
    (
        "cut spring softness",
        "not noted",
        "`food.material.toughness` with `food.material.strength` (`opening_law`): 0.185 J/m2 "
        "and 1.39 kPa for the nominal run's speed and step",
    ),
    (
        "springs that weaken by opening alone",
        "always",
        "`food.effects.edge.share`: 0",
    ),
    (
        "damping of the springs",
        "not noted",
        "no counterpart, because a bond is elastic until it breaks; the bulk's viscosity damps "
        "the faces (`food.material.damping_time`)",
    ),
    (
        "rest length of springs, inside and surface",
        "0.05 and 0.1 mm",
        "no counterpart, because it presses a closed cut apart",
    ),
    (
        "springs at the surface: their own stiffness, softness, contact",
        "",
        "`food.effects.skin.toughness`, `food.effects.skin.thickness`; for single points see "
        "the last line",
    ),
    (
        "contact stiffness",
        "not noted, 1,430 N/m by fit",
        "E over `numerics.flank_length`, per area: 1.5e8 Pa/m",
    ),
    (
        "contact damping",
        "not noted",
        "no counterpart, because a flank closes on the food at 1.4 mm/s at 50 mm/s, where 1 N "
        "s/m is 1.4 mN a contact; food and blade have damping: `food.material.damping_time`, "
        "`knife.lateral_relaxation_time`",
    ),
    (
        "contact friction coefficient",
        "0.5",
        "`food.material.friction`",
    ),
    (
        "contact friction stiffness (a speed)",
        "50 m/s",
        "no counterpart, because friction does not vanish at low speed: at one speed v it is "
        "`food.material.friction` = mu tanh(4 v / kf)",
    ),
    (
        "static friction coefficient (fixed at 0.5 there)",
        "0.5",
        "`food.material.static_friction`, `food.material.stribeck_velocity`",
    ),
    (
        "radius of the distance field",
        "0",
        "`knife.edge_radius`",
    ),
    (
        "knife: spine, edge, height, tip, depth",
        "3.5, 0.08, 59, 0.04, 150 mm",
        "`knife.spine_thickness`, `knife.edge_thickness`, `knife.height`, `knife.tip_height`, "
        "`knife.length`",
    ),
    (
        "rigid knife",
        "always",
        "`knife.lateral_stiffness`: up to 1e8 N/m; of no effect where both sides are alike",
    ),
    (
        "knife's motion and velocity",
        "50 mm/s down",
        "`motion.segments.speed`, `motion.segments.direction`, `motion.segments.distance`; "
        "draws, holds, waypoints and records are other segments",
    ),
    (
        "knife's height at the start",
        "2.1 mm above the block",
        "`clearance`",
    ),
    (
        "ground: stiffness, damping, friction coefficient",
        "1,000 N/m a vertex, not noted, 0.2",
        "`numerics.board_stiffness`, `numerics.board_damping_time`, `numerics.board_friction`",
    ),
    (
        "ground: friction stiffness",
        "1,000",
        "no counterpart, because food on the board sticks by the board's stiffness up to "
        "Coulomb's limit",
    ),
    (
        "ground radius",
        "read by nothing there",
        "no counterpart, because the food lies on the board",
    ),
    (
        "step, duration",
        "1e-5 s, 0.662 s",
        "`numerics.time_step`; the duration is the motion's. True masses: `numerics.mass_scaling`",
    ),
    (
        "sub-steps of a record",
        "500",
        "`period`",
    ),
    (
        "relaxation",
        "read by nothing there",
        "no counterpart, because there is nothing to set",
    ),
    (
        "device",
        "cpu",
        "`numerics.device`",
    ),
    (
        "which parameters each spring has for itself",
        "all shared",
        "`point_scales.toughness`, `point_scales.friction`, `point_scales.flank_stiffness`",
    ),
)
"""Its setting, its value in the reference case, and the field of a `Case` here (with a reason where
there is none). The tables of docs/results/disect.md are made of them.
"""
