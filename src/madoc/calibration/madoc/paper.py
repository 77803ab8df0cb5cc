"""The paper's hyperparameters of Madoc."""

from madoc.calibration.madoc.agents import AgentSettings

PAPER: dict[str, object] = {
    "mixing": "dop",
    "groups": "learned",
    "features": "raw",
    "hidden": (256, 256),
    "cloning_epochs": 100,
    "cloning_updates": 1000,
    "keep_cloning": True,
    "grouping_epochs": 200,
    "updates": 1000,
    "draws": 10,
    "horizon": 100,
    "learning_rate": 3e-4,
    "replay_capacity": 1_000_000,
    "patience": 0,
    "agents": AgentSettings(
        hidden=(256, 256),
        pair_bound=2.0,
        weigh_overlap=False,
        judge_rate=1.0,
        dropout=0.2,
        actor_batch=256,
        critic_rate=3e-4,
        actor_rate=3e-4,
        prior_rate=1e-3,
        average_rate=1.0,
        baseline=False,
        reward_size=0.0,
    ),
}
"""Hyperparameters of the paper (appendix C, and the authors' code) that differ from the defaults."""
