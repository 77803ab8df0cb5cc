"""Randomness of the stages: one seed, one stream a stage."""

import zlib

import jax
from jaxtyping import PRNGKeyArray

from madoc.errors import MadocError

LARGEST_SEED = 2**32 - 1
"""`jax.random.key` takes no more bits without 64-bit mode."""


def seed_key(seed: int) -> PRNGKeyArray:
    """The random key of a seed, which calibrations use as it is: their results name the seed.

    Raises:
        MadocError: The seed is negative or too large.
    """
    if not 0 <= seed <= LARGEST_SEED:
        raise MadocError(f"expected a seed from 0 to {LARGEST_SEED}, got {seed}")
    return jax.random.key(seed)


def stage_key(seed: int, stage: str) -> PRNGKeyArray:
    """The key of another stage; a stage does the same alone as within `madoc run`.

    The checksum is far from the small numbers that keys are split and folded with inside the stages.

    Raises:
        MadocError: The seed is negative or too large.
    """
    return jax.random.fold_in(seed_key(seed), zlib.crc32(stage.encode()))
