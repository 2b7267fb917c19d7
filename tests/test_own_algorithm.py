"""What docs/how_to/your_own_algorithm.md shows works, with fewer decisions."""

import re
from pathlib import Path

import numpy as np
import pytest

from sliceit_drake.learning.evaluation import SliceMetrics

pytestmark = pytest.mark.second_tier
pytest.importorskip("stable_baselines3")

PAGE = Path(__file__).parent.parent / "docs/how_to/your_own_algorithm.md"
FEWER = {
    "DECISIONS = 20_000": "DECISIONS = 2_000",
    "n_steps=256": "n_steps=64, batch_size=64",
    "GENERATIONS, DRAWS, BEST = 10, 16, 4": "GENERATIONS, DRAWS, BEST = 1, 3, 2",
    'render_mode="rgb_array"': "render_mode=None",
    "picture = env.render()": "",
    "print(": "metrics = (",
}


def test_two_algorithms_train_and_what_they_export_cuts_a_slice(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("output").mkdir()
    code = "\n".join(re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL))
    for long, short in FEWER.items():
        assert long in code
        code = code.replace(long, short)
    names: dict = {}
    exec(code, names)
    assert isinstance(names["metrics"], SliceMetrics)
    load, agent = names["load_network"], names["agent"]
    observation = names["env"].reset(seed=2)[0]
    # What is exported decides as what was trained does.
    own = names["dataclasses"].replace(agent, network="output/cross_entropy.onnx")
    expected = np.tanh(names["mean"] @ np.append(observation, 1.0))
    np.testing.assert_allclose(load(own)(observation), expected, atol=1e-5)
    policy, _ = names["model"].predict(observation, deterministic=True)
    found = np.clip(load(agent)(observation), -1.0, 1.0)
    np.testing.assert_allclose(found, policy, atol=1e-5)
