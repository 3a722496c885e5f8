import copy
from typing import Any

import jax
import numpy as np
import pytest

import dipn_jax
from dipn_jax.planning.methods import Policy
from dipn_jax.planning.planner import Rule

SIDE = (224, 224)


def _seen(**changes: Any) -> dipn_jax.Observation:
    """An empty table, but for what is changed, of any kind."""
    good = dipn_jax.Observation(
        np.zeros(SIDE, np.float32), np.ones((*SIDE, 3), np.float32), np.full(SIDE, -1, np.int32), slots=3
    )
    changed = copy.copy(good)
    for name, value in changes.items():
        object.__setattr__(changed, name, value)  # without the checks that tests alone have
    return changed


def _with(value: float, where: int = 7) -> np.ndarray:
    height = np.zeros(SIDE, np.float32)
    height[where, where] = value
    return height


BAD = {
    "height: has shape (480, 640)": {"height": np.zeros((480, 640), np.float32)},
    "height: has shape (1, 224, 224)": {"height": np.zeros((1, *SIDE), np.float32)},
    "height: holds uint16, want floating-point": {"height": np.zeros(SIDE, np.uint16)},
    "height: 1 values are NaN or infinite": {"height": _with(np.nan)},
    "height: 0 to 45; want metres above the table, not millimetres": {"height": _with(45.0)},
    "height: -0.7 to 0; want metres": {"height": _with(-0.7)},
    "height: at least 0.65 everywhere, so that no table is seen": {"height": 0.7 - _with(0.05)},
    "color: holds uint8": {"color": np.zeros((*SIDE, 3), np.uint8)},
    "color: 255 to 255; want 0 to 1": {"color": np.full((*SIDE, 3), 255, np.float32)},
    "color: has shape (224, 224, 4)": {"color": np.ones((*SIDE, 4), np.float32)},
    "label: holds float32": {"label": np.zeros(SIDE, np.float32)},
    "label: 3 to 3; want -1 on the table and less than slots=3": {"label": np.full(SIDE, 3, np.int32)},
    "label: -2 to -2": {"label": np.full(SIDE, -2, np.int32)},
    "slots: 0; want": {"slots": 0},
    "slots: 1000000000; want": {"slots": 10**9},
    "height: holds >f4, the byte order of other machines": {"height": _with(0.05).astype(">f4")},
    "height: 1 values are masked": {"height": np.ma.masked_equal(_with(0.05), np.float32(0.05))},
    "height: list, want an array": {"height": _with(0.05).tolist()},
    "label: memoryview, want an array": {"label": memoryview(np.zeros(SIDE, np.int32))},
}


def _act(*_: Any) -> Any:
    return "decided"


POLICY = Policy(_act, Rule(), np.array([0.1], np.float32))


@pytest.mark.parametrize("says", BAD)
def test_what_no_network_can_judge_is_refused_in_one_line(says: str) -> None:
    bad = _seen(**BAD[says])
    with pytest.raises(dipn_jax.UserError) as refused:
        dipn_jax.check_observation(bad)
    assert str(refused.value).startswith(f"observation.{says}") and "\n" not in str(refused.value)


def test_what_is_no_observation_is_refused() -> None:
    with pytest.raises(dipn_jax.UserError, match="observation: ndarray, want a dipn_jax"):
        dipn_jax.check_observation(np.zeros(SIDE, np.float32))


def test_a_policy_refuses_it_before_it_decides() -> None:
    for bad in (_seen(height=_with(np.nan)), _seen(height=_with(45.0)), _seen(label=np.full(SIDE, 3, np.int32))):
        with pytest.raises(dipn_jax.UserError, match=r"^observation\."):
            POLICY(jax.random.key(0), bad)


def test_what_decides_and_imagines_refuses_it_too() -> None:
    bad = _seen(height=_with(np.nan))
    with pytest.raises(dipn_jax.UserError, match="1 values are NaN"):
        dipn_jax.imagine(bad, np.zeros((3, 2)), np.zeros((3, 3)))
    with pytest.raises(dipn_jax.UserError, match="1 values are NaN"):
        dipn_jax.decide(jax.random.key(0), bad, None, None, count=2)
    with pytest.raises(dipn_jax.UserError, match="observation: dict, want a dipn_jax"):
        dipn_jax.decide(jax.random.key(0), {"height": 1}, None, None, count=2)  # type: ignore[arg-type]
    with pytest.raises(dipn_jax.UserError, match="1 values are NaN"):
        dipn_jax.decide(key=jax.random.key(0), observation=bad, predictor=None, scorer=None)


def test_a_table_on_which_all_lies_flat_is_refused_and_an_empty_one_is_not() -> None:
    label = np.full(SIDE, -1, np.int32)
    label[7, 5:9] = 1
    with pytest.raises(dipn_jax.UserError, match="no object is higher than 5 mm, and the fingers close 20 mm above"):
        POLICY(jax.random.key(0), _seen(height=_with(0.005), label=label))
    with pytest.raises(dipn_jax.UserError, match="no object is higher than 5 mm"):
        dipn_jax.decide(jax.random.key(0), _seen(height=_with(0.005), label=label), None, None)
    assert POLICY(jax.random.key(0), _seen(height=_with(0.03), label=label)) == "decided"
    assert POLICY(jax.random.key(0), _seen()) == "decided"


def test_what_a_camera_sees_passes() -> None:
    noisy = _seen(height=_with(-0.004) + _with(0.05, 9), label=np.full(SIDE, 2, np.int64))
    for good in (_seen(), noisy, jax.tree.map(jax.numpy.asarray, _seen())):
        dipn_jax.check_observation(good)
        assert POLICY(jax.random.key(0), good) == "decided"


def test_a_policy_can_be_traced() -> None:
    policy = Policy(lambda key, seen, *_: seen.height.sum(), Rule(), np.array([0.1], np.float32))
    assert jax.jit(lambda seen: policy(jax.random.key(0), seen))(_seen()) == 0
