import numpy as np
import pytest
from semantic import KINDS, harmless, identified, session, trial

from fpcal_bayes.io.sweeps import write_csv

#: A few that take no time; the program draws 25 of each kind.
FEW = (
    "sigma in nm",
    "one sigma of 1,000 um",
    "time_h in minutes",
    "a session resent",
    "a session's name in capitals",
    "estimate: a value + 5 um",
    "estimate: names reordered",
    "cell: wavelength in um",
    "campaign: the unit of dl says nm",
)


@pytest.mark.parametrize("kind", FEW)
def test_a_fault_is_told_or_harmless(kind, tmp_path):
    assert trial(kind, 1, tmp_path) in ("told", "harmless")


def test_there_are_many_kinds_and_the_judge_can_find_harm(tmp_path):
    assert len(KINDS) >= 40
    seen = []
    for seed in (1, 2):
        write_csv(tmp_path / "a.csv", session(np.random.default_rng(seed)), identified.__defaults__[0])
        seen.append(identified(tmp_path / "a.csv").estimate)
    assert harmless(seen[0], seen[0])
    assert not harmless(*seen)
