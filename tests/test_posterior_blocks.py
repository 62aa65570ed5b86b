from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.posterior.checkpoint import Block, BlockStore, random_from_numbers, random_to_numbers


def a_block(seed: int) -> Block:
    random = np.random.default_rng(seed)
    log_proposal = random.standard_normal((2, 3, 4))
    log_proposal[0, 1, 2] = -np.inf
    return Block(
        points=random.standard_normal((2, 3, 4, 5)),
        log_density=random.standard_normal((2, 3, 4)),
        log_proposal=log_proposal,
        accepted=random.random(2),
        random=np.array([random_to_numbers(np.random.RandomState(i)) for i in range(2)]),
        evaluations=123,
        seconds=4.5,
    )


def same(one: Block, other: Block) -> bool:
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(Block))


@pytest.fixture
def store(tmp_path) -> BlockStore:
    return BlockStore(tmp_path / "run.blocks", "one")


class TestStore:
    def test_nothing_there(self, store):
        assert store.read() == []
        assert not store.folder.exists()
        store.clear()

    def test_comes_back_to_the_last_bit(self, store):
        written = [a_block(i) for i in range(3)]
        for number, block in enumerate(written):
            store.append(number, block)
        read = BlockStore(store.folder, "one").read()
        assert len(read) == 3
        assert all(map(same, written, read))

    def test_ends_at_the_first_that_is_missing(self, store):
        for number in (0, 1, 3):
            store.append(number, a_block(number))
        assert len(store.read()) == 2

    def test_a_block_that_was_being_written_is_not_there(self, store):
        store.append(0, a_block(0))
        (whole,) = store.folder.iterdir()
        (store.folder / ("." + whole.name + ".half")).write_bytes(whole.read_bytes()[:100])
        assert len(store.read()) == 1

    def test_a_failed_write_leaves_what_was_there(self, store):
        store.append(0, a_block(0))
        with pytest.raises(AttributeError):
            store.append(1, replace(a_block(1), points=lambda: "no numbers"))
        assert [path.name for path in store.folder.iterdir()] == ["block-000000.npz"]

    @pytest.mark.parametrize("content", [b"", b"no block", b"PK\x03\x04 half"])
    def test_a_damaged_block_is_refused(self, store, content):
        store.append(0, a_block(0))
        (whole,) = store.folder.iterdir()
        whole.write_bytes(content)
        with pytest.raises(InputError, match=r"block-000000\.npz: not a block of draws .* without --resume"):
            store.read()

    def test_another_run_is_refused(self, store):
        store.append(0, a_block(0))
        with pytest.raises(InputError, match=r"run\.blocks: holds draws of other data, .* without --resume"):
            BlockStore(store.folder, "two").read()

    def test_clear(self, store):
        store.append(0, a_block(0))
        store.clear()
        assert store.read() == []


class TestRandom:
    @pytest.mark.parametrize("n_drawn", [0, 1, 7, 700])
    def test_state_goes_on_where_it_was(self, n_drawn):
        first = np.random.RandomState(5)
        first.standard_normal(n_drawn)  # an odd number leaves a second normal number in hand
        second = np.random.RandomState(0)
        second.set_state(random_from_numbers(random_to_numbers(first)))
        assert (first.standard_normal(9) == second.standard_normal(9)).all()
        assert first.randint(1000) == second.randint(1000)

    def test_state_goes_through_a_file(self, store, tmp_path: Path):
        store.append(0, a_block(0))
        restored = np.random.RandomState()
        restored.set_state(random_from_numbers(store.read()[0].random[1]))
        assert (restored.random_sample(5) == np.random.RandomState(1).random_sample(5)).all()
