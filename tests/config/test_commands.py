"""Command scripts: what they mean, and what is said about wrong ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eagle_rl.config.commands import BLEND_S, HOLD_S, load_commands, parse_commands
from eagle_rl.config.compose import known_names
from eagle_rl.config.schema import CommandsCfg
from eagle_rl.errors import ConfigError

SCRIPT = """
- {t: 0, vx: 0.5}
- {t: 2.0, wz: -1, p: 0.2}
- {t: 3.0, h: -0.1, vy: 0.3}
"""


def test_an_entry_holds_until_the_next_one_and_missing_keys_are_zero():
    script = parse_commands(SCRIPT)
    np.testing.assert_array_equal(script.at(0.0), [0.5, 0, 0, 0, 0])
    np.testing.assert_array_equal(script.at(1.99), [0.5, 0, 0, 0, 0])
    np.testing.assert_array_equal(script.at(2.5), [0, 0, -1, 0, 0.2])
    np.testing.assert_array_equal(script.at(100.0), [0, 0.3, 0, -0.1, 0])
    assert script.duration == 3.0 + HOLD_S


def test_a_change_is_half_done_after_half_the_blend():
    np.testing.assert_allclose(parse_commands(SCRIPT).at(2.0 + BLEND_S / 2), [0.25, 0, -0.5, 0, 0.1])


@given(st.floats(0, 6), st.floats(0, 0.01))
def test_commands_never_jump(t, dt):
    script = parse_commands(SCRIPT)
    slope = np.abs(np.diff(script.commands, axis=0)).max() / BLEND_S
    assert np.abs(script.at(t + dt) - script.at(t)).max() <= slope * dt + 1e-9


def test_every_fault_of_a_script_is_reported_with_its_line():
    text = "- {t: 1, vz: 1}\n- {t: 1.1, vx: fast}\n- 3\n- {vx: .inf, t: 9}"
    with pytest.raises(ConfigError) as caught:
        parse_commands(text, "x.yaml")
    faults = "\n".join(caught.value.faults)
    for part in ("x.yaml:1: t: got 1, expected 0", "x.yaml:1: vz", "x.yaml:2: t: got 1.1", "x.yaml:2: vx: got 'fast'"):
        assert part in faults
    assert "x.yaml:3: expected {t:" in faults
    assert "x.yaml:4: vx: got inf" in faults
    assert "t: got nan" not in faults


@pytest.mark.parametrize("text", ["", "a: 1", "[]", "- {t: 0, t: 0}", "- {t: 0", "- {vx: 1}", "3"])
def test_what_is_no_script_is_refused_in_words(text):
    with pytest.raises(ConfigError, match=r"x\.yaml"):
        parse_commands(text, "x.yaml")


def test_an_unknown_script_is_answered_with_the_nearest():
    with pytest.raises(ConfigError, match="demo"):
        load_commands("dmo")


@pytest.mark.parametrize("name", known_names("commands"))
def test_shipped_scripts_stay_inside_the_finishing_ranges(name):
    ranges = CommandsCfg()
    order = (ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_z, ranges.base_height, ranges.body_pitch)
    low, high = np.array([bound.finishing for bound in order]).T
    commands = load_commands(name).commands
    assert (commands >= low).all()
    assert (commands <= high).all()
