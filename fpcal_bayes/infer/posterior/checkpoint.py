"""Blocks of draws on disk: sampling that is killed goes on where it was.

Each block is a file of its own, written aside and renamed, with the state of the random numbers behind its last step.
What is on disk is therefore whole at any moment, and a reader never meets a writer.
"""

from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import replacing
from fpcal_bayes.core.typing import Floats

_KEY_WORDS = 624  # of a Mersenne Twister, which emcee uses


@dataclass(frozen=True)
class Block:
    """Some consecutive steps of all ensembles."""

    points: Floats  # scaled unknowns, shape (n_ensembles, n_steps, n_walkers, n)
    log_density: Floats  # of the target, shape (n_ensembles, n_steps, n_walkers)
    log_proposal: Floats  # of the atlas, likewise
    accepted: Floats  # accepted steps of each ensemble, shape (n_ensembles,)
    random: Floats  # state of each ensemble's random numbers after the block, shape (n_ensembles, 627)
    evaluations: int  # points at which the density was evaluated
    seconds: float  # time the block took


class BlockStore:
    """The blocks of one run, in a folder made with the first; `identity` is a hash of all that the draws depend on."""

    def __init__(self, folder: Path, identity: str) -> None:
        self.folder, self.identity = folder, identity

    def read(self) -> list[Block]:
        """All blocks in order, up to the first that is missing."""
        blocks: list[Block] = []
        while (path := self._path(len(blocks))).exists():
            blocks.append(self._read(path))
        return blocks

    def append(self, number: int, block: Block) -> None:
        """Write block `number`, whole or not at all."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with replacing(self._path(number)) as temporary, temporary.open("wb") as file:
            np.savez(file, identity=self.identity, **vars(block))

    def clear(self) -> None:
        """Remove all blocks, but not their folder: it is locked."""
        for path in self.folder.glob("*.[hnt]*"):
            path.unlink()

    def _path(self, number: int) -> Path:
        return self.folder / f"block-{number:06d}.npz"

    def _read(self, path: Path) -> Block:
        try:
            with path.open("rb") as stream, np.load(stream) as file:
                found = dict(file)
            identity, evaluations, seconds = (found.pop(name).item() for name in ("identity", "evaluations", "seconds"))
            block = Block(**found, evaluations=evaluations, seconds=seconds)
        except (BadZipFile, EOFError, OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{path}: not a block of draws ({error}); sample without --resume to start anew"
            ) from error
        if identity != self.identity:
            raise InputError(
                f"{self.folder}: holds draws of other data, another cell, other priors or another seed; "
                "sample without --resume to start anew"
            )
        return block


def random_to_numbers(state: np.random.RandomState) -> Floats:
    """State of a random number generator as numbers, shape (627,)."""
    _, key, position, has_gauss, gauss = state.get_state(legacy=True)
    return np.concatenate([key.astype(float), [float(position), float(has_gauss), float(gauss)]])


def random_from_numbers(numbers: Floats) -> tuple[str, NDArray[np.uint32], int, int, float]:
    """The state that `random_to_numbers` wrote, for ``RandomState.set_state``."""
    key = numbers[:_KEY_WORDS].astype(np.uint32)
    position, has_gauss, gauss = numbers[_KEY_WORDS:]
    return "MT19937", key, int(position), int(has_gauss), float(gauss)
