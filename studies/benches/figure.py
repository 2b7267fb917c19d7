"""Draws one record of each law beside the finite elements, and the noises and their spectra."""

import argparse
from pathlib import Path

import numpy as np
from scipy.signal import welch

from studies.benches.draw import LAWS, Draw
from studies.benches.noise import FAMILIES, unit_noise
from studies.figures import BLUE, GREEN, ORANGE, RED, new_figure, save_figure, tidy

__all__ = ["add_arguments", "run"]

FIGURES = Path(__file__).resolve().parents[2] / "docs" / "results" / "figures"
SEED = 4
SHADES = {"hold": "0.9", "retract": "#e8f1f8", "second_pass": "#e6f4ef"}
RATE = 500.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds nothing: the study has no arguments."""


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    _laws()
    _noises()
    return 0


def _laws() -> None:
    figure = new_figure(12, 8.5)
    axes = figure.subplots(len(LAWS), 2, width_ratios=(2, 1), sharey="row")
    for row, law in zip(axes, LAWS, strict=True):
        bench = Draw(law, SEED)
        labels = list(bench.middle)
        session = bench.session()
        for panel, condition in zip(row, (labels[1], labels[3]), strict=True):
            quiet = session.record(bench.middle[condition])
            noisy = bench.noise.added_to(quiet, np.random.default_rng(0))
            assert quiet.force is not None and noisy.force is not None
            for phase in quiet.metadata.motion.phases:
                if phase.label in SHADES:
                    panel.axvspan(phase.start, phase.end, color=SHADES[phase.label], lw=0)
            along = np.einsum("nc,nc->n", noisy.force, noisy.rotation[:, :, 0])
            panel.plot(noisy.time, noisy.force[:, 2], color=BLUE, lw=0.5, alpha=0.5)
            panel.plot(quiet.time, quiet.force[:, 2], color=BLUE, lw=1.2, label="upwards")
            panel.plot(noisy.time, along, color=ORANGE, lw=0.9, label="along the edge")
            name = law.replace("_", " ")
            tidy(panel, f"{name}: {condition}, {bench.noise.family} noise")
        row[0].set_ylabel("force on the knife [N]")
    for panel in axes[-1]:
        panel.set_xlabel("time [s]")
    axes[0, 0].legend(loc="upper center", frameon=False)
    figure.suptitle(
        "A press with hold, withdrawal and second pass, and a draw, by each law, as it is recorded "
        "(thin) and without noise\nGrey: the knife is held. Blue: withdrawn. Green: second pass."
    )
    save_figure(figure, FIGURES / "benches_laws.png", 90)


def _noises() -> None:
    figure = new_figure(11, 3.8)
    series, spectra = figure.subplots(1, 2, width_ratios=(2, 1))
    rng = np.random.default_rng(1)
    shown = [name for name in FAMILIES if name not in ("quantised", "jittered")]
    for k, (name, colour) in enumerate(zip(shown, (BLUE, ORANGE, GREEN, RED, "0.3"), strict=True)):
        values = unit_noise(name, 20_000, RATE, rng)
        window = slice(0, 500)
        time = np.arange(500) / RATE
        series.plot(time, np.clip(values[window, 0], -6, 6) - 8.0 * k, color=colour, lw=0.7)
        series.text(-0.02, -8.0 * k, name, ha="right", va="center", fontsize=9)
        f, power = welch(values[:, 0], RATE, nperseg=4096)
        spectra.loglog(f[1:], power[1:], color=colour, lw=1.0, label=name)
    tidy(series, "One second of noise of a deviation of 1, by family (spikes cut off)")
    tidy(spectra, "Power spectra")
    series.set_xlabel("time [s]")
    series.set_yticks([])
    spectra.set_xlabel("frequency [Hz]")
    spectra.set_ylabel("power [1/Hz]")
    spectra.legend(frameon=False, fontsize=8)
    save_figure(figure, FIGURES / "benches_noise.png", 90)
