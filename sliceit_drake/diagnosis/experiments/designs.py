"""The experiments that a diagnosis may propose: motions of the arm, scaled to food and records.

Those without something to do by hand need no person beyond the next piece of food.
"""

import dataclasses as dc

from sliceit_drake.cutting.motion import (
    ConstantSpeed,
    Hold,
    MotionPlan,
    PressAndDraw,
    Retract,
    Segment,
    Waypoints,
)

__all__ = ["Experiment", "Scale", "menu"]

OVERTRAVEL = 2e-4
"""How far a cut goes into the board, metres."""
BOARD_PRESS = 5e-4
"""How far a press on the bare board goes, metres: tens of newtons on a board of 1e5 N/m."""
SLOWEST, FASTEST = 1e-3, 0.1
"""Speeds that the station follows while it cuts, m/s."""
RAMP = 0.5
QUICK_RAMP = 2.0
"""Accelerations up to 30 mm/s and above, m/s^2."""
TILT = 0.5
"""Turn of the tool about the edge in the air, rad."""
AIR = 0.08
"""Height over the food where nothing is touched, metres."""
WEIGHT = 1.0
"""Hung on the knife, kg."""
NARROW = 0.8
"""Size of the narrow food over that of the food."""


@dc.dataclass(frozen=True)
class Scale:
    """What motions are scaled to.

    Attributes:
        height, width: Of the food's section, metres.
        length: Of the edge, metres.
        speed: Of the press in the records, m/s.
        clearance: Height of the edge over the food at the start, metres.
    """

    height: float
    width: float
    length: float
    speed: float = 0.02
    clearance: float = 3e-3

    def times(self, factor: float) -> float:
        """A multiple of the records' speed that the station can follow, m/s."""
        return round(min(max(factor * self.speed, SLOWEST), FASTEST), 6)


@dc.dataclass(frozen=True)
class Experiment:
    """One kind of slice.

    Attributes:
        name: Of the scenario and the records' condition.
        what: In words.
        motion: Of the knife.
        clearance: Height of the edge over the food at the start, metres.
        offset: Shift of the edge's middle along the edge at the start, metres.
        by_hand: What a person must do before; "" for nothing.
        food: Whether there is any; else the clearance is over where its top would be.
        peeled: Whether the skin is off.
        sharpened: Whether the knife is sharpened before the first slice.
        size: Of the food's section over that of the records'.
        weight: Hung on the knife in phases "weight", kg.
    """

    name: str
    what: str
    motion: MotionPlan
    clearance: float
    offset: float = 0.0
    by_hand: str = ""
    food: bool = True
    peeled: bool = False
    sharpened: bool = False
    size: float = 1.0
    weight: float = 0.0


def menu(scale: Scale) -> list[Experiment]:
    """All that may be proposed, those without handwork first."""
    return [*_cuts(scale), *_in_air(scale), *_by_hand(scale)]


def _ramp(speed: float) -> float:
    return RAMP if speed <= 0.03 else QUICK_RAMP


def _press(distance: float, speed: float, label: str = "slice") -> ConstantSpeed:
    way = round(distance, 6)
    return ConstantSpeed(speed=speed, distance=way, acceleration=_ramp(speed), label=label)


def _retract(distance: float, speed: float, label: str = "retract") -> Retract:
    way = round(distance, 6)
    return Retract(distance=way, speed=speed, acceleration=_ramp(speed), label=label)


def _air(duration: float = 0.3) -> Hold:
    return Hold(duration=duration, label="air")


def _end() -> Hold:
    """On the board."""
    return Hold(duration=0.3, label="hold")


def _plan(*segments: Segment) -> MotionPlan:
    return MotionPlan(segments=list(segments))


def _through(scale: Scale) -> float:
    """From the start through the food."""
    return round(scale.clearance + scale.height + OVERTRAVEL, 6)


def _tour(scale: Scale, speeds: tuple[float, float] = (0.3, 3.0)) -> MotionPlan:
    """Slow to the middle, held there, fast through; out slowly, once more in, out fast."""
    slow, fast = (scale.times(x) for x in speeds)
    way = _through(scale)
    half = scale.clearance + 0.5 * scale.height
    again = way - scale.clearance - 2.0 * OVERTRAVEL
    return _plan(
        _air(),
        _press(half, slow),
        Hold(duration=2.0, label="hold"),
        _press(way - half, fast),
        _end(),
        _retract(way, scale.times(1.0)),
        _air(0.2),
        _press(again, scale.times(1.0), "second_pass"),
        _retract(again, fast),
        _air(),
    )


def _cuts(scale: Scale) -> list[Experiment]:
    way, half = _through(scale), scale.clearance + 0.5 * scale.height
    usual, slow, fast = scale.times(1.0), scale.times(0.3), scale.times(3.0)
    again = way - scale.clearance - 2.0 * OVERTRAVEL
    out = [
        Experiment(
            "slow",
            f"a press at {1e3 * slow:.3g} mm/s, and out",
            _plan(_air(), _press(way, slow), _end(), _retract(way, usual), _air()),
            scale.clearance,
        ),
        Experiment(
            "fast",
            f"a press at {1e3 * fast:.3g} mm/s, and out",
            _plan(_air(), _press(way, fast), _end(), _retract(way, usual), _air()),
            scale.clearance,
        ),
        Experiment(
            "hold",
            "a press that is held in the middle of the food for 3 s",
            _plan(
                _air(),
                _press(half, usual),
                Hold(duration=3.0, label="hold"),
                _press(way - half, usual),
                _end(),
                _retract(way, fast),
                _air(),
            ),
            scale.clearance,
        ),
        Experiment(
            "second_pass",
            "a press, out slowly, once more through the open cut, out fast",
            _plan(
                _air(),
                _press(way, usual),
                _end(),
                _retract(way, slow),
                _air(0.2),
                _press(again, usual, "second_pass"),
                _retract(again, fast),
                _air(),
            ),
            scale.clearance,
        ),
        Experiment(
            "tour",
            "slowly to the middle, held, fast through, out, once more through the open cut",
            _tour(scale),
            scale.clearance,
        ),
    ]
    for ratio in (1.0, 3.0):
        # The draw is centred, so that the food stays under the edge as long as may be.
        reach = 0.5 * (scale.length - scale.width)
        travel = ratio * way
        if 0.5 * travel > reach:
            continue
        out.append(
            Experiment(
                f"draw_{ratio:.0f}",
                f"a press with {ratio:.0f} m along the edge for each metre down",
                _plan(
                    _air(),
                    PressAndDraw(
                        press_speed=usual, distance=way, draw_ratio=ratio, acceleration=RAMP
                    ),
                    _end(),
                    _retract(way, fast),
                    _air(),
                ),
                scale.clearance,
                offset=round(-0.5 * travel, 6),
            )
        )
    return out


def _in_air(scale: Scale) -> list[Experiment]:
    usual, fast = scale.times(1.0), scale.times(3.0)
    turned = [[TILT, 0.0, 0.0]]
    return [
        Experiment(
            "air",
            "up and down over the food at two speeds, in two poses of the tool",
            _plan(
                _air(0.5),
                _press(0.02, usual, "air"),
                _retract(0.02, fast, "air"),
                Waypoints(
                    times=[0.8, 1.6], positions=[[0.0] * 3] * 2, rotations=turned * 2, label="air"
                ),
                _press(0.02, fast, "air"),
                _retract(0.02, usual, "air"),
            ),
            AIR,
        )
    ]


def _by_hand(scale: Scale) -> list[Experiment]:
    narrow = dc.replace(scale, height=NARROW * scale.height, width=NARROW * scale.width)
    first = _plan(_air(), _press(_through(scale), scale.times(1.0)), _end())
    # Down to a clearance's height over the board, then slowly.
    press = scale.clearance + BOARD_PRESS
    return [
        Experiment(
            "board",
            "the bare board pressed at two speeds, held, withdrawn",
            _plan(
                _air(),
                _press(scale.height, scale.times(3.0), "approach"),
                _press(press, scale.times(1.0), "board_press"),
                Hold(duration=0.7, label="board_press"),
                _retract(press, scale.times(1.0)),
                _press(press, scale.times(0.3), "board_press"),
                Hold(duration=0.3, label="board_press"),
                _retract(press + scale.height, scale.times(3.0)),
                _air(),
            ),
            scale.clearance,
            by_hand="take the food away",
            food=False,
        ),
        Experiment(
            "weight",
            f"a known mass of {WEIGHT:g} kg on the knife in two poses, in the air",
            _plan(
                _air(0.5),
                Hold(duration=1.0, label="weight"),
                _air(),
                Waypoints(
                    times=[0.8], positions=[[0.0] * 3], rotations=[[TILT, 0.0, 0.0]], label="air"
                ),
                _air(0.5),
                Hold(duration=1.0, label="weight"),
            ),
            AIR,
            by_hand=f"hang {WEIGHT:g} kg on the knife at the middle of its edge while the phases "
            '"weight" last (1 s, twice), and take it off between; no food is needed',
            food=False,
            weight=WEIGHT,
        ),
        Experiment(
            "peeled",
            "peeled food: slowly to the middle, held, fast through, out, once more",
            _tour(scale),
            scale.clearance,
            by_hand="take the skin off the food",
            peeled=True,
        ),
        Experiment(
            "narrow",
            f"food of {NARROW:g} times the size: slowly to the middle, held, fast through, out",
            _tour(narrow),
            scale.clearance,
            by_hand=f"take a piece of {1e3 * narrow.height:.3g} mm height, or as near as there is, "
            "and write its size into the scenario and its motion",
            size=NARROW,
        ),
        Experiment(
            "sharpened",
            "a press with a freshly sharpened knife",
            first,
            scale.clearance,
            by_hand="sharpen the knife before the first slice",
            sharpened=True,
        ),
    ]
