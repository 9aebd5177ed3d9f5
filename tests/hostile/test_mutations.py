"""Good files with damage: whatever is changed, a reader gives a value or an error of its own."""

from __future__ import annotations

import pytest

from tests.hostile.readers import READERS

SMALL = [reader for reader in READERS if reader.good]
FEW, MANY = 40, 10_000
"""Mutations of each reader in every run; of all readers together in the slow one."""


@pytest.mark.parametrize("reader", SMALL, ids=lambda reader: reader.name)
def test_damaged_files_give_values_or_errors(reader, ask):
    for seed in range(FEW // 5 if reader.apart else FEW):
        ask(reader.name, f"mutation {seed}")


TEXTS = [
    reader for reader in SMALL
    if reader.suffix in (".obj", ".json", ".csv", ".bvh", ".usda")
]  # fmt: skip


@pytest.mark.parametrize("reader", TEXTS, ids=lambda reader: reader.name)
def test_numbers_that_cannot_be_give_values_or_errors(reader, ask):
    for seed in range(FEW // 5 if reader.apart else FEW):
        ask(reader.name, f"number {seed}")


@pytest.mark.slow
@pytest.mark.parametrize("reader", SMALL, ids=lambda reader: reader.name)
def test_ten_thousand_damaged_files(reader, ask):
    for seed in range(FEW, FEW + MANY // len(SMALL) // (5 if reader.apart else 1)):
        ask(reader.name, f"mutation {seed}")
