"""What a sensor and a logger add to a record: families of noise, each with a spectrum or a shape of
its own."""

import dataclasses as dc
from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["FAMILIES", "Noise", "unit_noise"]

LEVER = 0.06
"""Noise of a torque over that of a force, metres."""


def _white(count: int, rate: float, rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=(count, 6))


def _autoregressive(count: int, rate: float, rng: np.random.Generator) -> np.ndarray:
    """A fifth of the variance is white; the rest falls to 1/e in 40 ms."""
    keep = float(np.exp(-1.0 / (0.04 * rate)))
    steps = rng.normal(size=(count, 6))
    steps[1:] *= np.sqrt(1.0 - keep * keep)
    return np.sqrt(0.8) * lfilter([1.0], [1.0, -keep], steps, axis=0) + np.sqrt(0.2) * _white(
        count, rate, rng
    )


def _pink(count: int, rate: float, rng: np.random.Generator) -> np.ndarray:
    """A power spectrum of 1 / f from 0.1 Hz on, made by shaping white noise."""
    padded = max(count, round(20.0 * rate))
    f = np.maximum(np.fft.rfftfreq(padded, 1.0 / rate), 0.1)
    gain = f**-0.5
    gain /= np.sqrt(np.mean(gain**2))
    shaped = np.fft.rfft(rng.normal(size=(padded, 6)), axis=0) * gain[:, None]
    return np.asarray(np.fft.irfft(shaped, padded, axis=0)[:count])


def _tails(count: int, rate: float, rng: np.random.Generator) -> np.ndarray:
    """Student's t with 4 degrees of freedom, and a spike of 20 deviations in 4 of 1,000 rows."""
    out = rng.standard_t(4, size=(count, 6)) / np.sqrt(2.0)
    hit = rng.random(count) < 0.004
    out[hit] += 20.0 * rng.choice((-1.0, 1.0), size=(int(hit.sum()), 6))
    return np.asarray(out)


def _hum(count: int, rate: float, rng: np.random.Generator) -> np.ndarray:
    """Mains of 50 Hz and its third harmonic (aliased as the rate will), half the variance; the rest
    is white."""
    angle = 2.0 * np.pi * 50.0 * np.arange(count)[:, None] / rate + rng.uniform(0.0, 2 * np.pi, 6)
    wave = np.sqrt(2.0) * (0.95 * np.sin(angle) + np.sqrt(1.0 - 0.95**2) * np.sin(3.0 * angle))
    return np.asarray(np.sqrt(0.5) * (wave + _white(count, rate, rng)))


FAMILIES: dict[str, Callable[[int, float, np.random.Generator], np.ndarray]] = {
    "white": _white,
    "autoregressive": _autoregressive,
    "pink": _pink,
    "tails": _tails,
    "hum": _hum,
    "quantised": _white,
    "jittered": _white,
}
"""Rows of six channels of about unit variance (of `tails` without its spikes), by family. What is
quantised or jittered is so beside white noise."""


def unit_noise(family: str, count: int, rate: float, rng: np.random.Generator) -> np.ndarray:
    """Noise of a family [count, 6] at a rate, Hz, with about unit variance."""
    return FAMILIES[family](count, rate, rng)


@dc.dataclass(frozen=True)
class Noise:
    """Noise of a session.

    Attributes:
        family: One of `FAMILIES`.
        rate: Readings a second, 125 or 500 Hz.
        deviation: Of a force, N.
        resolution: Step of the readings of forces, N, where they are quantised.
        jitter: Deviation of the stamps over the time between readings, where they are jittered.
    """

    family: str = "white"
    rate: float = 500.0
    deviation: float = 0.05
    resolution: float = 0.25
    jitter: float = 0.15

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Noise":
        """Noise of 0.03 to 0.2 N: good wrist sensors and the e-Series' own sensor."""
        return cls(
            family=str(rng.choice(list(FAMILIES))),
            rate=float(rng.choice((125.0, 500.0))),
            deviation=float(np.exp(rng.uniform(np.log(0.03), np.log(0.2)))),
            resolution=float(rng.uniform(0.1, 0.5)),
            jitter=float(rng.uniform(0.05, 0.2)),
        )

    def added_to(self, record: SliceRecord, rng: np.random.Generator) -> SliceRecord:
        """A noise-free record with this noise, tared in its first air phase."""
        assert record.force is not None and record.torque is not None
        noise = self.deviation * unit_noise(self.family, len(record), self.rate, rng)
        noise[:, :3] *= LEVER
        first = record.first_phase("air")
        noise -= np.median(noise[first], axis=0) if first.any() else 0.0
        force = record.force + np.einsum("nij,nj->ni", record.rotation, noise[:, 3:])
        torque = record.torque + np.einsum("nij,nj->ni", record.rotation, noise[:, :3])
        time = record.time
        if self.family == "quantised":
            force = np.round(force / self.resolution) * self.resolution
        if self.family == "jittered":
            # A stamp may be off by less than half the time to the next, so that they increase.
            off = np.clip(self.jitter * rng.normal(size=len(time)), -0.45, 0.45)
            time = time + off / self.rate
        return dc.replace(record, time=time, force=force, torque=torque)
