"""Films that a run has left, as the page plays them."""

import base64
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from madoc.report.reading import read_arrays


@dataclass(frozen=True)
class Film:
    """Panels that play together, each a sheet of pictures.

    Attributes:
        sheets: The sheet of each panel by its name: a WebP in base64, its pictures row after row.
        time: Time of each picture, s.
        size: Width and height of a picture in pixels.
        columns: Pictures in a row of a sheet.
    """

    sheets: dict[str, str]
    time: Float[np.ndarray, " frames"]
    size: tuple[int, int]
    columns: int

    @property
    def rows(self) -> int:
        """Rows of a sheet."""
        return -(-len(self.time) // self.columns)


def read_film(path: Path) -> Film | None:
    """The film in a file of `pipeline.film_stage`; None where there is none."""
    arrays = read_arrays(path, "names", "time", "size", "columns")
    if arrays is None:
        return None
    names = [str(name) for name in arrays["names"]]
    sheets = {name: base64.b64encode(arrays[f"sheet_{index}"].tobytes()).decode() for index, name in enumerate(names)}
    width, height = arrays["size"].tolist()
    return Film(sheets, np.asarray(arrays["time"], float), (width, height), int(arrays["columns"]))
