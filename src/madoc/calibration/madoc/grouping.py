"""Which parameters act alike: a VAE embeds each parameter's identity by its effect, k-means groups the embeddings."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree
from sklearn.cluster import KMeans
from sklearn.decomposition import PCA

from madoc.learning import replay
from madoc.learning.networks import Network, descend, scan_updates

LATENT = 16
"""Width of the embedding, and how often the parameter's value is repeated beside it (appendix C)."""
PROJECTED = 3


class GroupingVAE(eqx.Module):
    """Encoder: identity -> embedding. Decoder: (s, a, ξ_i, embedding) -> s'.

    Eq. (10) without its KL term, as the paper trains it (appendix C): the embedding only has to distinguish
    parameters, nothing is generated from it, so it is the encoder's mean.
    """

    encoder: Network
    decoder: Network

    def __init__(
        self, parameters: int, pair: int, observation: int, hidden: tuple[int, ...], *, key: PRNGKeyArray
    ) -> None:
        of_encoder, of_decoder = jax.random.split(key)
        self.encoder = Network(parameters, LATENT, hidden, key=of_encoder)
        self.decoder = Network(pair + 2 * LATENT, observation, hidden, key=of_decoder)

    @property
    def parameters(self) -> int:
        """How many identities there are."""
        return int(self.encoder.layers[0].in_features)

    def embeddings(self) -> Float[Array, "d latent"]:
        """One embedding a parameter."""
        return self.encoder(jnp.eye(self.parameters))

    def __call__(self, pair: Array, value: Array, identity: Array) -> Float[Array, "rows observation"]:
        """The predicted s' features, given whose value (in [-1, 1]) was moved."""
        repeated = jnp.repeat(value[:, None], LATENT, axis=1)
        return self.decoder(jnp.concatenate([pair, repeated, self.embeddings()[identity]], axis=-1))


def reconstruction_loss(
    vae: GroupingVAE, pair: Array, following: Array, value: Array, identity: Int[Array, " rows"]
) -> Float[Array, ""]:
    """The first term of Eq. (10) with a unit-variance decoder: mean squared error of s'."""
    return jnp.mean((vae(pair, value, identity) - following) ** 2)


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
) -> tuple[GroupingVAE, PyTree, dict[str, Array]]:
    """`count` updates on simulated rows."""

    def update(carry: tuple, key: PRNGKeyArray) -> tuple[tuple, dict[str, Array]]:
        vae, optimiser_state = carry
        drawn = replay.sample(rows, key, batch)
        identity = drawn["identity"].astype(jnp.int32)
        value = jnp.take_along_axis(drawn["parameters"], identity[:, None], axis=1)[:, 0]
        loss, gradients = eqx.filter_value_and_grad(reconstruction_loss)(
            vae, drawn["pair"], drawn["following"], value, identity
        )
        return descend(optimiser, gradients, optimiser_state, vae), {"grouping_loss": loss}

    (vae, optimiser_state), metrics = scan_updates(update, (vae, optimiser_state), key, count)
    return vae, optimiser_state, metrics


def one_at_a_time(key: PRNGKeyArray, count: int) -> Float[np.ndarray, "d d"]:
    """Draws in [-1, 1], one a parameter: that parameter uniform, all others at mid-range."""
    values = jax.random.uniform(key, (count,), minval=-1.0, maxval=1.0)
    return np.diag(np.asarray(values, dtype=np.float64))


def cluster(embeddings: Float[Array, "d latent"], groups: int, seed: int) -> Int[np.ndarray, " d"]:
    """Group labels of parameters: PCA to three dimensions, then k-means; labels in order of first appearance."""
    if groups == 1:
        return np.zeros(len(embeddings), dtype=np.int64)
    projected = project(embeddings)
    labels = KMeans(groups, n_init=10, random_state=seed).fit_predict(projected)
    order = {label: rank for rank, label in enumerate(dict.fromkeys(labels.tolist()))}
    return np.array([order[label] for label in labels.tolist()])


def project(embeddings: Float[Array, "d latent"]) -> Float[np.ndarray, "d projected"]:
    """The embeddings' first principal components, at most three."""
    rows = np.asarray(embeddings, dtype=np.float64)
    return PCA(min(PROJECTED, *rows.shape), svd_solver="full").fit_transform(rows)


def vote(schemes: Int[np.ndarray, "votes d"]) -> Int[np.ndarray, " d"]:
    """The scheme proposed most often; the earliest of equals."""
    distinct, first, counts = np.unique(schemes, axis=0, return_index=True, return_counts=True)
    return distinct[np.lexsort((first, -counts))[0]]


def members(labels: Int[np.ndarray, " d"], groups: int) -> Bool[np.ndarray, "groups d"]:
    """Which parameters belong to which group."""
    return labels[None] == np.arange(groups)[:, None]
