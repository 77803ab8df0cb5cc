"""A saved policy on a robot's computer: it needs NumPy only, no JAX and no pickle."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class NumpyPolicy:
    """The deterministic action of a policy saved as `policy.npz`.

    Attributes:
        task_name: The robot it was learnt for.
        weights: Matrix (inputs, outputs) of each layer.
        biases: Vector of each layer.
        offset: Subtracted from the observation.
        scale: Divisor of the observation after that.
    """

    task_name: str
    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    offset: np.ndarray
    scale: np.ndarray

    @classmethod
    def load(cls, path: str | Path) -> "NumpyPolicy":
        """Read a policy file.

        Raises:
            ValueError: The file is not a policy that Madoc saved.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                about = json.loads(str(file["about"]))
                layers = range(about["layers"])
                return cls(
                    about["task"],
                    tuple(file[f"weight_{layer}"] for layer in layers),
                    tuple(file[f"bias_{layer}"] for layer in layers),
                    file["offset"],
                    file["scale"],
                )
        except FileNotFoundError:
            raise ValueError(f"there is no policy file {path}") from None
        except Exception as error:
            raise ValueError(f"{path} is not a policy that madoc saved: {error}") from error

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Actions in [-1, 1] for observations of shape (..., observation)."""
        rows = (np.asarray(observation, dtype=np.float32) - self.offset) / self.scale
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            rows = np.maximum(rows @ weight + bias, 0.0)
        mean = rows @ self.weights[-1] + self.biases[-1]
        return np.tanh(mean[..., : mean.shape[-1] // 2])
