"""Groups of parameters with similar effects: k-means of a VAE's embeddings, and a vote over epochs.

The VAE embeds parameters by their effects on simulated motion: Eq. (10) of Jiang et al. 2024.
"""

from dataclasses import dataclass, replace
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from madoc.learning import replay
from madoc.learning.networks import Network, Observations, Scalar, adam, minimise

Grouping = Literal["each", "learned", "one"]
VOTING = 0.05
"""Share in [0, 1] of the epochs of grouping, the last ones, in which the VAE's groups are voted on; the authors'."""
VOTES = 10
"""Number of votes in each of these epochs: the authors take about 9, at random, in 1000 updates."""
LATENT = 16
"""Width of the embedding, and number of repetitions of the parameter's value beside it (appendix C)."""
PROJECTED = 3
"""Number of principal components in which the embeddings are clustered."""


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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Votes:
    """The VAE, the state of its optimiser, and the groups that it proposed in the last epochs of grouping."""

    vae: GroupingVAE
    optimiser: PyTree
    schemes: Int[np.ndarray, "votes d"]


def voting_epochs(epochs: int) -> int:
    """Number of the epochs of grouping, the last ones, in which groups are voted on."""
    return max(1, int(VOTING * epochs))


def begin_votes(vae: GroupingVAE, *, epochs: int, learning_rate: float) -> Votes:
    """A VAE that has not learnt, with room for the votes of as many epochs of grouping."""
    count = int(vae.encoder.layers[0].in_features)
    schemes = np.zeros((voting_epochs(epochs) * VOTES, count), dtype=np.int64)
    return Votes(vae, adam(learning_rate).init(eqx.filter(vae, eqx.is_array)), schemes)


def learn_votes(
    votes: Votes,
    rows: replay.Replay,
    key: PRNGKeyArray,
    *,
    learning_rate: float,
    batch: int,
    updates: int,
    groups: int | None,
    seed: int,
) -> tuple[Votes, float]:
    """An epoch of the VAE on simulated rows, and its mean loss; `VOTES` times in it a vote, unless `groups` is None.

    While groups are voted on, updates are rounded up to as many for each vote.
    """
    parts, losses = VOTES if groups else 1, []
    for key_of_part in jax.random.split(key, parts):
        vae, optimiser, loss = train(
            votes.vae,
            votes.optimiser,
            rows,
            key_of_part,
            optimiser=adam(learning_rate),
            batch=batch,
            count=-(-updates // parts),
        )
        votes = replace(votes, vae=vae, optimiser=optimiser)
        losses.append(loss)
        if groups:
            scheme = cluster(vae.embeddings(), groups, seed=seed)
            votes = replace(votes, schemes=np.concatenate([votes.schemes[1:], scheme[None]]))
    return votes, float(np.mean(losses))


def one_at_a_time(key: PRNGKeyArray, count: int) -> Float[np.ndarray, "d d"]:
    """A draw in [-1, 1] for each parameter: that parameter uniform, all others at mid-range."""
    values = jax.random.uniform(key, (count,), minval=-1.0, maxval=1.0)
    return np.diag(np.asarray(values, dtype=np.float64))


def cluster(embeddings: Float[Array | np.ndarray, "d latent"], groups: int, seed: int) -> Int[np.ndarray, " d"]:
    """Group labels of parameters, in order of first appearance: k-means of the first three principal components."""
    rows = np.asarray(embeddings, dtype=np.float64)
    from sklearn.cluster import KMeans  # slow to import, and only needed here
    from sklearn.decomposition import PCA

    projected = PCA(min(PROJECTED, *rows.shape), svd_solver="full").fit_transform(rows)
    labels = KMeans(groups, n_init=10, random_state=seed).fit_predict(projected)
    _, first, label = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[label]


def vote(schemes: Int[np.ndarray, "votes d"]) -> Int[np.ndarray, " d"]:
    """The most frequent scheme; of equally frequent ones the earliest."""
    distinct, first, counts = np.unique(schemes, axis=0, return_index=True, return_counts=True)
    return distinct[np.lexsort((first, -counts))[0]]


def agreement(schemes: Int[np.ndarray, "votes d"]) -> float:
    """Mean adjusted Rand index between the scheme that wins the vote and all schemes; 1 if they are the same."""
    from sklearn.metrics import adjusted_rand_score  # slow to import, and only needed here

    winner = vote(schemes)
    return float(np.mean([adjusted_rand_score(winner, scheme) for scheme in schemes]))


def members(labels: Int[np.ndarray, " d"], groups: int) -> Bool[np.ndarray, "groups d"]:
    """Which parameters belong to which group."""
    return labels[None] == np.arange(groups)[:, None]
