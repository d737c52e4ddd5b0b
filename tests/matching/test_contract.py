"""Every method keeps the contract; the laws and the methods are in `registration_contract`."""

from __future__ import annotations

import pytest
from registration_contract import CASES, LAWS, a_batch_is_its_pairs


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(
    "law",
    [
        # compiles each method a second time
        pytest.param(law, marks=pytest.mark.slow if law is a_batch_is_its_pairs else ())
        for law in LAWS
    ],
    ids=lambda law: law.__name__,
)
def test_contract(law, name) -> None:
    law(CASES[name])
