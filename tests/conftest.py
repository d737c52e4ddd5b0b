"""Settings that every test runs under."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ["VANEJAX_CACHE_DIR"] = "off"  # a test compiles what it tests

import jax
import pytest
from headless_browser import CHROMIUM, HeadlessBrowser

jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture
def double_precision():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("no chromium or google-chrome on the PATH")
    with HeadlessBrowser() as running:
        yield running
