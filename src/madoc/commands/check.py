"""`madoc check`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from madoc.commands.answer import Answer, Output


@dataclass(frozen=True)
class Check:
    """Say what logs of a robot of your own can and cannot tell, before anything is solved.

    Exit code 2 where a calibration would be refused, 0 otherwise.
    """

    spec: Annotated[Positional[Path], arg(metavar="SPEC")]
    """The spec file of the robot, as robot.yaml."""
    data: tuple[Path, ...]
    """Logs: files (CSV, npz, HDF5, Parquet, MCAP) or folders of them, Minari or LeRobot directories."""
    clip_actions: bool = False
    """Clip actions outside their ranges instead of refusing them."""
    velocities: Literal["logged", "differences"] = "logged"
    """differences puts velocities from positions where the logs have none, as `calibrate` does if told so."""
    budget: int = 300_000
    """Control steps to forecast the time of."""
    forecast: bool = True
    """Forecast how long methods would take: the longest part of a check."""
    seed: int = 0
    """Of the stretches of the log that are looked at."""
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Read, look, and tell."""
        from madoc.diagnosis import tables, to_json
        from madoc.pipeline.check_stage import check_logs

        budget = self.budget if self.forecast else None
        found = check_logs(
            self.spec,
            self.data,
            clip_actions=self.clip_actions,
            velocities=self.velocities,
            budget=budget,
            seed=self.seed,
        )
        status = "rejected" if found.fatal else "finished"
        if found.diagnosis is None:
            assert found.refusal is not None
            told = {"fatal": True, "findings": [found.refusal.to_json()]}
            return Answer(told, (f"fatal: {found.refusal.sentence}",), status)
        forecasts = [forecast.to_json() for forecast in found.forecasts]
        lines = tuple(forecast.sentence for forecast in found.forecasts)
        return Answer(
            to_json(found.diagnosis, found.space) | {"forecast": forecasts},
            (*tables(found.diagnosis, found.space), *lines),
            status,
        )
