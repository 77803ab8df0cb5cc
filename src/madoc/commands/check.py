"""`madoc check`."""

from dataclasses import asdict, dataclass, field
from typing import Annotated

from tyro.conf import OmitArgPrefixes, arg

from madoc.commands.answer import Answer, Output
from madoc.pipeline.orders import CheckOrder, Permission


@dataclass(frozen=True)
class Check:
    """Say what logs of a robot of your own can and cannot tell, before anything is solved.

    Exit code 2 where a calibration would be refused, 0 otherwise.
    """

    order: Annotated[CheckOrder, arg(name="")]
    permission: OmitArgPrefixes[Permission] = field(default_factory=Permission)
    output: OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> Answer:
        """Read the logs and check them."""
        from madoc.diagnosis import tables, to_json
        from madoc.pipeline import check_logs

        checked = check_logs(self.order, permission=self.permission)
        status = "rejected" if checked.fatal else "finished"
        if checked.diagnosis is None:
            assert checked.refusal is not None
            answer = {"fatal": True, "findings": [checked.refusal.to_json()]}
            return Answer(answer, (f"fatal: {checked.refusal.sentence}",), status)
        forecasts = [asdict(forecast) for forecast in checked.forecasts]
        lines = tuple(forecast.sentence for forecast in checked.forecasts)
        return Answer(
            to_json(checked.diagnosis, checked.space) | {"forecast": forecasts},
            (*tables(checked.diagnosis, checked.space), *lines),
            status,
        )
