"""The picture of the README: held-out motion of a run, measured, in the model as given, and calibrated.

python examples/record_logs.py examples/arm/arm.yaml examples/arm/truth.json logs --noise 0.02
madoc calibrate examples/arm/arm.yaml --data logs --out run
python benchmarks/picture.py run shoulder elbow
"""

import argparse
from pathlib import Path

import numpy as np
from drawing import line_chart

from madoc.report.reading import read_arrays

PICTURE = Path(__file__).parents[1] / "docs" / "arm.svg"
WIDTH, HEIGHT, HEAD = 340, 190, 46
"""Of a panel, and of what stands above the panels."""
LINES = (
    ("measured", "measured", "#222", 6.0, 0.35),
    ("before", "the model as given", "#c77700", 1.6, 1.0),
    ("after", "calibrated", "#0b63ce", 1.8, 1.0),
)
"""Name in `evidence.npz`, in words, colour, width and opacity, the last on top."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("signals", nargs="+")
    arguments = parser.parse_args()
    PICTURE.write_text(picture(read_arrays(arguments.run / "evidence.npz"), arguments.signals))
    print(PICTURE)


def picture(evidence: dict[str, np.ndarray], signals: list[str]) -> str:
    """A panel for each signal, side by side, of the first held-out run."""
    style = "".join(
        f".{name} {{ fill: none; stroke: {colour}; stroke-width: {width}; opacity: {opacity} }} "
        for name, _, colour, width, opacity in LINES
    )
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH * len(signals)} {HEIGHT + HEAD}">',
        '<rect width="100%" height="100%" fill="#fff"/>',
        f"<style>text {{ font: 11.5px system-ui, sans-serif; fill: #555 }} .grid {{ stroke: #ddd }} {style}</style>",
    ]
    for place, (name, words, *_) in enumerate(LINES):
        x = 46 + 160 * place
        parts.append(f'<path class="{name}" d="M{x} 14h24"/><text x="{x + 30}" y="18">{words}</text>')
    for place, signal in enumerate(signals):
        index = [str(each) for each in evidence["signals"]].index(signal)
        lines = [(name, evidence[name][0, :, index].astype(float)) for name, *_ in LINES]
        title = f"{signal} (rad) over time (s)"
        chart = line_chart(evidence["time"], lines, x_title=title, width=WIDTH, height=HEIGHT)
        parts.append(f'<g transform="translate({WIDTH * place} {HEAD - 14})">{chart}</g>')
    return "\n".join([*parts, "</svg>", ""])


if __name__ == "__main__":
    main()
