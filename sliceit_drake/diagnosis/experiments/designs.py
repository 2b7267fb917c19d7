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

__all__ = ["CLEARANCE", "Experiment", "Scale", "menu"]

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
CLEARANCE = 3e-3
"""Height of the edge over the food at the start of a cut, metres."""


@dc.dataclass(frozen=True)
class Scale:
    """What motions are scaled to.

    Attributes:
        height, width: Of the food's section, metres.
        length: Of the edge, metres.
        speed: Of the press in the records, m/s.
    """

    height: float
    width: float
    length: float
    speed: float = 0.02

    def times(self, factor: float) -> float:
        """A multiple of the records' speed that the station can follow, m/s."""
        return round(min(max(factor * self.speed, SLOWEST), FASTEST), 6)

    @property
    def through(self) -> float:
        """From the start of a cut through the food, metres."""
        return round(CLEARANCE + self.height + OVERTRAVEL, 6)

    @property
    def half(self) -> float:
        """From the start of a cut to the middle of the food, metres."""
        return CLEARANCE + 0.5 * self.height

    @property
    def again(self) -> float:
        """Of a second pass through the open cut, metres."""
        return self.through - CLEARANCE - 2.0 * OVERTRAVEL


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
    clearance: float = CLEARANCE
    offset: float = 0.0
    by_hand: str = ""
    food: bool = True
    peeled: bool = False
    sharpened: bool = False
    size: float = 1.0
    weight: float = 0.0


def menu(scale: Scale) -> list[Experiment]:
    """All that may be proposed, those without handwork first."""
    return [*_cuts(scale), _in_air(scale), *_by_hand(scale)]


def _ramp(speed: float) -> float:
    return RAMP if speed <= 0.03 else QUICK_RAMP


def _press(distance: float, speed: float, label: str = "slice") -> ConstantSpeed:
    way = round(distance, 6)
    return ConstantSpeed(speed=speed, distance=way, acceleration=_ramp(speed), label=label)


def _retract(distance: float, speed: float, label: str = "retract") -> Retract:
    way = round(distance, 6)
    return Retract(distance=way, speed=speed, acceleration=_ramp(speed), label=label)


def _rest(duration: float = 0.3, label: str = "air") -> Hold:
    return Hold(duration=duration, label=label)


def _turn(*times: float) -> Waypoints:
    """To a pose turned by `TILT`, and on in it."""
    return Waypoints(
        times=list(times),
        positions=[[0.0] * 3] * len(times),
        rotations=[[TILT, 0.0, 0.0]] * len(times),
        label="air",
    )


def _plan(*segments: Segment) -> MotionPlan:
    """From the air over the food and back."""
    return MotionPlan(segments=[_rest(), *segments, _rest()])


def _tour(scale: Scale) -> MotionPlan:
    """Slow to the middle, held there, fast through; out slowly, once more in, out fast."""
    usual, slow, fast = (scale.times(x) for x in (1.0, 0.3, 3.0))
    return _plan(
        _press(scale.half, slow),
        _rest(2.0, "hold"),
        _press(scale.through - scale.half, fast),
        _rest(label="hold"),
        _retract(scale.through, usual),
        _rest(0.2),
        _press(scale.again, usual, "second_pass"),
        _retract(scale.again, fast),
    )


def _cuts(scale: Scale) -> list[Experiment]:
    usual, slow, fast = (scale.times(x) for x in (1.0, 0.3, 3.0))
    way, on_board = scale.through, _rest(label="hold")
    out = [
        Experiment(
            name,
            f"a press at {1e3 * speed:.3g} mm/s, and out",
            _plan(_press(way, speed), on_board, _retract(way, usual)),
        )
        for name, speed in (("slow", slow), ("fast", fast))
    ]
    out += [
        Experiment(
            "hold",
            "a press that is held in the middle of the food for 3 s",
            _plan(
                _press(scale.half, usual),
                _rest(3.0, "hold"),
                _press(way - scale.half, usual),
                on_board,
                _retract(way, fast),
            ),
        ),
        Experiment(
            "second_pass",
            "a press, out slowly, once more through the open cut, out fast",
            _plan(
                _press(way, usual),
                on_board,
                _retract(way, slow),
                _rest(0.2),
                _press(scale.again, usual, "second_pass"),
                _retract(scale.again, fast),
            ),
        ),
        Experiment(
            "tour",
            "slowly to the middle, held, fast through, out, once more through the open cut",
            _tour(scale),
        ),
    ]
    for ratio in (1.0, 3.0):
        # The draw is centred, so that the food stays under the edge as long as may be.
        travel = ratio * way
        if travel > scale.length - scale.width:
            continue
        draw = PressAndDraw(press_speed=usual, distance=way, draw_ratio=ratio, acceleration=RAMP)
        out.append(
            Experiment(
                f"draw_{ratio:.0f}",
                f"a press with {ratio:.0f} m along the edge for each metre down",
                _plan(draw, on_board, _retract(way, fast)),
                offset=round(-0.5 * travel, 6),
            )
        )
    return out


def _in_air(scale: Scale) -> Experiment:
    usual, fast = scale.times(1.0), scale.times(3.0)
    segments: list[Segment] = [
        _rest(0.5),
        _press(0.02, usual, "air"),
        _retract(0.02, fast, "air"),
        _turn(0.8, 1.6),
        _press(0.02, fast, "air"),
        _retract(0.02, usual, "air"),
    ]
    what = "up and down over the food at two speeds, in two poses of the tool"
    return Experiment("air", what, MotionPlan(segments=segments), AIR)


def _by_hand(scale: Scale) -> list[Experiment]:
    usual, slow, fast = (scale.times(x) for x in (1.0, 0.3, 3.0))
    narrow = dc.replace(scale, height=NARROW * scale.height, width=NARROW * scale.width)
    # Down to a clearance's height over the board, then slowly.
    press = CLEARANCE + BOARD_PRESS
    hung: list[Segment] = [_rest(0.5), _rest(1.0, "weight")]
    return [
        Experiment(
            "board",
            "the bare board pressed at two speeds, held, withdrawn",
            _plan(
                _press(scale.height, fast, "approach"),
                _press(press, usual, "board_press"),
                _rest(0.7, "board_press"),
                _retract(press, usual),
                _press(press, slow, "board_press"),
                _rest(label="board_press"),
                _retract(press + scale.height, fast),
            ),
            by_hand="take the food away",
            food=False,
        ),
        Experiment(
            "weight",
            f"a known mass of {WEIGHT:g} kg on the knife in two poses, in the air",
            MotionPlan(segments=[*hung, _rest(), _turn(0.8), *hung]),
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
            by_hand="take the skin off the food",
            peeled=True,
        ),
        Experiment(
            "narrow",
            f"food of {NARROW:g} times the size: slowly to the middle, held, fast through, out",
            _tour(narrow),
            by_hand=f"take a piece of {1e3 * narrow.height:.3g} mm height, or as near as there is, "
            "and write its size into the scenario and its motion",
            size=NARROW,
        ),
        Experiment(
            "sharpened",
            "a press with a freshly sharpened knife",
            MotionPlan(segments=[_rest(), _press(scale.through, usual), _rest(label="hold")]),
            by_hand="sharpen the knife before the first slice",
            sharpened=True,
        ),
    ]
