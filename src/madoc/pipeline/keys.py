"""Random keys of the stages: one seed, and a stream of its own for each stage."""

import jax
from jaxtyping import PRNGKeyArray

from madoc.errors import MadocError
from madoc.types import named_key

LARGEST_SEED = 2**32 - 1
"""Largest seed: `jax.random.key` takes 32 bits."""


def seed_key(seed: int) -> PRNGKeyArray:
    """The random key of a seed, which calibrations use as it is: their results name the seed.

    Raises:
        MadocError: The seed is negative or too large.
    """
    check_seed(seed)
    return jax.random.key(seed)


def check_seed(seed: int) -> None:
    """Refuse a seed that is negative or too large."""
    if not 0 <= seed <= LARGEST_SEED:
        raise MadocError(f"expected a seed from 0 to {LARGEST_SEED}, got {seed}")


def stage_key(seed: int, stage: str) -> PRNGKeyArray:
    """The random key of a stage by its name, the same within `madoc run` as alone."""
    return named_key(seed_key(seed), stage)
