"""A VAE that embeds parameters by their effects on simulated motion: Eq. (10) of Jiang et al. 2024."""

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from madoc.learning import replay
from madoc.learning.networks import Network, Observations, Scalar, minimise

LATENT = 16
"""Width of the embedding, and number of repetitions of the parameter's value beside it (appendix C)."""


class GroupingVAE(eqx.Module):
    """Encoder: identity -> embedding. Decoder: (s, a, ξ_i, embedding) -> s' - s.

    Eq. (10) without its KL term, as the paper trains it (appendix C): nothing is generated from the embedding, which
    only has to distinguish parameters, so it is the encoder's mean. The paper writes s'; the authors' code predicts the
    change, as this does, in which the parameter's effect does not vanish beside the state.
    """

    encoder: Network
    decoder: Network

    def __init__(
        self, parameters: int, pair: int, observation: int, hidden: tuple[int, ...], *, key: PRNGKeyArray
    ) -> None:
        of_encoder, of_decoder = jax.random.split(key)
        self.encoder = Network(parameters, LATENT, hidden, key=of_encoder)
        self.decoder = Network(pair + 2 * LATENT, observation, hidden, key=of_decoder)

    def embeddings(self) -> Float[Array, "d latent"]:
        """The embedding of each parameter."""
        return self.encoder(jnp.eye(int(self.encoder.layers[0].in_features)))

    def __call__(self, pair: Array, value: Array, identity: Array) -> Observations:
        """The predicted features of s' - s, given the value (in [-1, 1]) of the varied parameter, and its index."""
        repeated = jnp.repeat(value[:, None], LATENT, axis=1)
        return self.decoder(jnp.concatenate([pair, repeated, self.embeddings()[identity]], axis=-1))


def reconstruction_loss(
    vae: GroupingVAE, pair: Array, change: Array, value: Array, identity: Int[Array, " rows"]
) -> Scalar:
    """The first term of Eq. (10) with a unit-variance decoder: mean squared error of s' - s."""
    return jnp.mean((vae(pair, value, identity) - change) ** 2)


@eqx.filter_jit
def train(
    vae: GroupingVAE,
    optimiser_state: PyTree,
    rows: replay.Replay,
    key: PRNGKeyArray,
    *,
    optimiser: optax.GradientTransformation,
    batch: int,
    count: int,
) -> tuple[GroupingVAE, PyTree, Scalar]:
    """`count` updates on simulated rows, whose s' is described by s' - s; also the mean loss."""

    def loss_of(vae: GroupingVAE, key: PRNGKeyArray) -> Scalar:
        drawn = replay.sample(rows, key, batch)
        identity = drawn["identity"].astype(jnp.int32)
        value = jnp.take_along_axis(drawn["parameters"], identity[:, None], axis=1)[:, 0]
        return reconstruction_loss(vae, drawn["pair"], drawn["following"], value, identity)

    return minimise(loss_of, vae, optimiser_state, key, optimiser=optimiser, count=count)
