"""An episode: what an agent did in a world, as a record and as a NetCDF file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pbrl_ppl.errors import EpisodeError
from pbrl_ppl.files import write_atomically
from pbrl_ppl.history import History, from_segments
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, STATE_UNITS, WRENCH, WRENCH_UNITS

Array = NDArray[np.float64]

_KIND = "episode"
#: Variables of a file, and their dimensions.
_DIMS = {
    "states": ("time", "body", "state"),
    "observed": ("interval", "body", "state"),
    "action": ("interval", "body", "wrench"),
    "reward": ("time",),
    "bumped": ("interval",),
    "planned": ("interval",),
    "seconds": ("interval",),
    "estimate": ("interval", "parameter"),
}
_UNITS = {
    "states": ", ".join(STATE_UNITS),
    "observed": ", ".join(STATE_UNITS),
    "action": ", ".join(WRENCH_UNITS),
    "reward": "m",
    "seconds": "s",
}


class Episode:
    """An episode of an agent in a world; treat it as read-only.

    Parameters
    ----------
    dataset : xarray.Dataset
        With the variables

        - ``states`` (time, body, state): where the bodies were, the start first (SI units);
        - ``observed`` (interval, body, state): the ends of the intervals as the agent observed
          them, with the world's noise;
        - ``action`` (interval, body, wrench): held in the interval (N, N, N m);
        - ``reward`` (time,): minus the L2 distance from the goal (m);
        - ``bumped``, ``planned`` (interval,): whether a body touched something, and whether the
          action was planned rather than random;
        - ``seconds`` (interval,): what choosing the action and the update after it took (s);
        - ``estimate`` (interval, parameter): physical parameters that the agent believed in after
          the interval; NaN before it did.

        In ``attrs``: the scene as TOML, the agent's name, the seed, ``sigma`` of the world, the
        limit of steps, and whether the goal was reached; ``world``, its description, if it has one,
        and ``added``, as JSON, the effects that the agent added to its model.

    Raises
    ------
    EpisodeError
        If a variable or an attribute is missing, or has other dimensions.
    """

    def __init__(self, dataset: xr.Dataset) -> None:
        for name, dims in _DIMS.items():
            got = dataset[name].dims if name in dataset else None
            if got != dims:
                raise EpisodeError(
                    f"episode: variable {name!r} has dimensions {got}, expected {dims}; write the"
                    " file with Episode.save"
                )
        missing = {"scene", "agent", "seed", "sigma", "limit", "reached"} - {*dataset.attrs}
        if missing:
            raise EpisodeError(f"episode: it does not say {', '.join(sorted(missing))}")
        self.dataset = dataset

    @classmethod
    def of(
        cls,
        scene: Scene,
        states: Array,
        estimates: Sequence[Mapping[str, float]],
        recorded: Mapping[str, Any],
        **attrs: Any,
    ) -> Episode:
        """Make an episode of arrays.

        Parameters
        ----------
        scene : Scene
            Orders the bodies.
        states : ndarray
            The start first, shape (time + 1, body, 6), SI units.
        estimates : sequence of mapping
            What the agent believed after each interval, by label.
        recorded : mapping
            The other variables by name.
        **attrs
            ``agent``, ``seed``, ``sigma``, ``limit``, ``reached``, ``world``, ``added``.
        """
        labels = list(dict.fromkeys(label for each in estimates for label in each))
        believed = [[each.get(label, np.nan) for label in labels] for each in estimates]
        n, k = len(states) - 1, len(scene.moving)
        variables: dict[str, Any] = {
            **recorded,
            "states": states,
            "observed": np.reshape(recorded["observed"], (n, k, len(STATE))),
            "action": np.reshape(recorded["action"], (n, k, len(WRENCH))),
            "estimate": np.reshape(np.array(believed, dtype=float), (n, len(labels))),
        }
        coords = {
            "time": ("time", scene.time_step * np.arange(n + 1), {"units": "s"}),
            "body": [body.name for body in scene.moving],
            "state": list(STATE),
            "wrench": list(WRENCH),
            "parameter": np.array(labels, dtype=object),
        }
        given = {
            name: (dims, np.asarray(variables[name]), _units(name)) for name, dims in _DIMS.items()
        }
        said = {"pbrl_ppl": _KIND, "scene": scene.to_toml(), **attrs}
        return cls(xr.Dataset(given, coords, said))

    @classmethod
    def load(cls, path: str | Path, scene: Scene | None = None) -> Episode:
        """Read an episode file.

        Parameters
        ----------
        path : str or Path
            A file that :meth:`save` wrote.
        scene : Scene, optional
            The scene that is expected.

        Raises
        ------
        EpisodeError
            If it is missing, is no episode, or is one of another scene.
        """
        path = Path(path)
        if not path.is_file():
            raise EpisodeError(f"{path}: there is no such file; check the path")
        try:
            with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as stored:
                dataset = stored.load()
        except Exception as error:  # HDF5 raises many kinds on a damaged file
            raise EpisodeError(f"{path}: this is not a NetCDF file: {error}") from None
        if dataset.attrs.get("pbrl_ppl") != _KIND:
            raise EpisodeError(f"{path}: this is no episode file; save one with Episode.save")
        try:
            episode = cls(dataset)
        except EpisodeError as error:
            raise EpisodeError(f"{path}: {error}") from None
        if scene is not None and episode.scene != scene:
            raise EpisodeError(
                f"{path}: this is an episode of another scene ({_differences(episode.scene, scene)}"
                " differ); give its own scene, or another folder"
            )
        return episode

    def save(self, path: str | Path) -> None:
        """Write a NetCDF file, whole or not at all.

        Raises
        ------
        OutputError
            If it cannot be written there.
        """
        write_atomically(Path(path), lambda to: self.dataset.to_netcdf(to, engine="h5netcdf"))

    @property
    def scene(self) -> Scene:
        """Where it took place."""
        return Scene.from_toml(self.dataset.attrs["scene"])

    @property
    def agent(self) -> str:
        """The agent's name."""
        return str(self.dataset.attrs["agent"])

    @property
    def seed(self) -> int:
        """The world's and the agent's."""
        return int(self.dataset.attrs["seed"])

    @property
    def reached(self) -> bool:
        """Whether the goal was reached."""
        return bool(self.dataset.attrs["reached"])

    @property
    def steps(self) -> int:
        """Actions taken."""
        return int(self.dataset.sizes["interval"])

    @property
    def bumps(self) -> int:
        """Intervals in which a body touched a wall or another."""
        return int(self.dataset["bumped"].sum())

    @property
    def added(self) -> list[dict[str, Any]]:
        """Effects added to the model and kept: ``effect``, ``body``, after how many transitions."""
        return list(json.loads(self.dataset.attrs.get("added", "[]")))

    def rewards(self, steps: int) -> Array:
        """Reward at each of so many steps and the start, shape (steps + 1,), m.

        After the goal is reached, the bodies stay, and so does the reward.
        """
        own = self.dataset["reward"].to_numpy()[: steps + 1]
        return np.concatenate([own, np.full(steps + 1 - len(own), own[-1])])

    def history(self) -> History:
        """The transitions as the agent observed them: each from its own state, one interval long.

        Raises
        ------
        HistoryError
            If no action was taken.
        """
        states = self.dataset["states"].to_numpy()
        action, observed = self.dataset["action"].to_numpy(), self.dataset["observed"].to_numpy()
        return from_segments(self.scene, states[:-1], action[:, None], observed[:, None])


def _units(name: str) -> dict[str, str]:
    return {"units": _UNITS[name]} if name in _UNITS else {}


def _differences(found: Scene, expected: Scene) -> str:
    """Names of the fields in which two scenes differ."""
    own = vars(expected)
    return ", ".join(name for name, value in vars(found).items() if value != own.get(name))
