"""Averages of scalars that not every step has."""

import math

import pytest
import torch

from eagle_rl.algorithms.running_means import RunningMeans


def test_tags_are_averaged_over_the_steps_that_had_a_value():
    means = RunningMeans()
    means.add({"a": 1.0, "b": torch.tensor(10.0)})
    means.add({"a": torch.tensor(3.0), "b": torch.tensor(math.nan)})
    means.add({"b": 20.0, "c": 7.0})
    means.add({})
    assert means.pop() == {"a": 2.0, "b": 15.0, "c": 7.0}
    assert means.pop() == {}


def test_a_tag_without_any_value_is_left_out_and_an_infinite_one_stays_infinite():
    means = RunningMeans()
    means.add({"nothing": math.nan, "inf": math.inf})
    means.add({"nothing": math.nan, "inf": 1.0})
    assert means.pop() == {"inf": math.inf}


@pytest.mark.parametrize("value", [0.1, 1e-20, -3e20])
def test_the_values_of_a_reused_dict_are_copied(value):
    means, log = RunningMeans(), {"a": torch.tensor(value)}
    means.add(log)
    log["a"].zero_()
    assert means.pop()["a"] == pytest.approx(value)
