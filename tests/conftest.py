"""Settings that every test runs under."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ["VANEJAX_CACHE_DIR"] = "off"  # a test compiles what it tests

import jax

jax.config.update("jax_numpy_rank_promotion", "raise")
