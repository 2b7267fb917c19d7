"""Causes in the wrench sensor and its mounting, as `cutting.bench_errors.SensorErrors` has them."""

from sliceit_drake.diagnosis.cause import Cause, CauseParameter, Scan

__all__ = ["SensorDelay", "SensorGain", "SensorTilt", "SensorZero"]


class SensorZero(Cause):
    """A zero that is off, and drifts, the same in all records, in the knife's axes."""

    name = "sensor_zero"
    family = "sensor"
    parameters = tuple(
        CauseParameter(f"{kind}_{axis}", unit, size, adds_to=f"bench.sensor.force_{field}.{k}")
        for kind, unit, size, field in (
            ("bias", "N", 0.3, "bias"),
            ("drift", "N/s", 0.03, "drift_rate"),
        )
        for k, axis in enumerate("xyz")
    )
    signature = "there without contact; independent of depth and speed"
    experiment = "air"


class SensorGain(Cause):
    """A gain that is off by a share, in all channels."""

    name = "sensor_gain"
    family = "sensor"
    parameters = (
        CauseParameter("gain", "", 0.08, low=-0.9, high=5.0, adds_to="bench.sensor.gain"),
    )
    signature = "scales everything, a known weight too"
    experiment = "weight"


class SensorTilt(Cause):
    """A sensor that sits turned about Kx and Ky: forces of one axis show on another."""

    name = "sensor_tilt"
    family = "sensor"
    parameters = tuple(
        CauseParameter(
            f"about_{axis}", "rad", 0.06, low=-0.5, high=0.5, adds_to=f"bench.sensor.tilt.{k}"
        )
        for k, axis in enumerate("xy")
    )
    signature = "sideways forces in proportion to the press; turns with the tool"
    experiment = "weight"


class SensorDelay(Cause):
    """Readings that come late: equal low-pass filters in a row, or a shift in time."""

    name = "sensor_delay"
    family = "sensor"
    parameters = (
        CauseParameter("delay", "s", 0.01, low=0.0, high=0.2, adds_to="bench.sensor.delay"),
    )
    scan = Scan("stages", "", (1.0, 4.0), "bench.sensor.delay_stages")
    signature = "minus the delay times the rate of the force; in depth it goes with the speed"
    experiment = "retract"
