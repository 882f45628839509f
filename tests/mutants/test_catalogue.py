"""Mutants that no longer fit the code would be killed by nobody; ``make mutants`` tries those that do."""

from __future__ import annotations

import pytest

from tests.mutants.__main__ import ROOT
from tests.mutants.catalogue import MUTANTS


def test_there_are_enough_mutants_and_no_two_are_alike():
    assert len(MUTANTS) >= 30
    assert len({(mutant.file, mutant.new) for mutant in MUTANTS}) == len(MUTANTS)


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.new)
def test_a_mutant_fits_its_file_once_and_names_tests_that_exist(mutant):
    assert (ROOT / mutant.file).read_text(encoding="utf-8").count(mutant.old) == 1
    assert mutant.old != mutant.new
    assert all((ROOT / "tests" / file).is_file() for file in mutant.tests.split())
