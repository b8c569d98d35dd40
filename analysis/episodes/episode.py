"""Record of an episode of an agent in a world, and its NetCDF file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from episodes.world import EpisodeError
from pbrl_ppl import History, Scene
from pbrl_ppl.history import from_segments
from pbrl_ppl.state import STATE, STATE_UNITS, WRENCH, WRENCH_UNITS, Floats
from pbrl_ppl.system.files import write_atomically

_KIND = "episode"
#: Variables of an episode, and their dimensions.
VARIABLES = {
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

        - ``states`` (time, body, state): exact states, the start first (SI units);
        - ``observed`` (interval, body, state): states at the ends of the intervals as the agent
          observed them, with the world's noise;
        - ``action`` (interval, body, wrench): held in the interval (N, N, N m);
        - ``reward`` (time,): minus the L2 distance from the goal (m);
        - ``bumped``, ``planned`` (interval,): whether a body touched something, and whether the
          action was planned rather than random;
        - ``seconds`` (interval,): time to choose the action and to update the agent (s);
        - ``estimate`` (interval, parameter): the agent's estimates of physical parameters after the
          interval; NaN before the first.

        In ``attrs``: the scene as TOML, the agent's name, the seed, ``sigma`` of the world, the
        limit of steps, and whether the goal was reached; ``world``, its description, if it has one,
        and ``added``, the effects that the agent added to its model, as JSON.

    Raises
    ------
    EpisodeError
        If a variable or an attribute is missing, or has other dimensions.
    """

    def __init__(self, dataset: xr.Dataset) -> None:
        for name, dims in VARIABLES.items():
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
    def of(cls, scene: Scene, rows: Mapping[str, Sequence[Any]], **attrs: Any) -> Episode:
        """Make an episode from its rows.

        Parameters
        ----------
        scene : Scene
            Orders the bodies.
        rows : mapping
            The variables by name, ``states`` and ``reward`` from the start on; ``estimate`` as
            mappings by label.
        **attrs
            ``agent``, ``seed``, ``sigma``, ``limit``, ``reached``, ``world``, ``added``.
        """
        labels = list(dict.fromkeys(label for each in rows["estimate"] for label in each))
        estimates = [[each.get(label, np.nan) for label in labels] for each in rows["estimate"]]
        times = scene.time_step * np.arange(len(rows["states"]))
        coords: dict[str, Any] = {
            "time": ("time", times, {"units": "s"}),
            "body": [body.name for body in scene.moving],
            "state": list(STATE),
            "wrench": list(WRENCH),
            "parameter": np.array(labels, dtype=object),
        }
        variables = {}
        for name, dims in VARIABLES.items():
            dtype = bool if name in ("bumped", "planned") else float
            values = np.array({**rows, "estimate": estimates}[name], dtype=dtype)
            units = {"units": _UNITS[name]} if name in _UNITS else {}
            shape = len(values), *(len(coords[dim]) for dim in dims[1:])
            variables[name] = (dims, values.reshape(shape), units)
        about = {"pbrl_ppl": _KIND, "scene": scene.to_toml(), **attrs}
        return cls(xr.Dataset(variables, coords, about))

    @classmethod
    def load(cls, path: str | Path, scene: Scene | None = None) -> Episode:
        """Read an episode file.

        Parameters
        ----------
        path : str or Path
            A file that :meth:`save` wrote.
        scene : Scene, optional
            Expected scene.

        Raises
        ------
        EpisodeError
            If it is missing, no episode file, or of another scene.
        """
        path = Path(path)
        if not path.is_file():
            raise EpisodeError(f"{path}: there is no such file; check the path")
        try:
            with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as stored:
                dataset = stored.load()
        except Exception as error:  # HDF5 raises many kinds for a damaged file
            raise EpisodeError(f"{path}: this is not a NetCDF file: {error}") from None
        if dataset.attrs.get("pbrl_ppl") != _KIND:
            raise EpisodeError(f"{path}: this is no episode file; save one with Episode.save")
        try:
            episode = cls(dataset)
        except EpisodeError as error:
            raise EpisodeError(f"{path}: {error}") from None
        if scene is not None and episode.scene != scene:
            fields = vars(episode.scene).items()
            differ = (name for name, value in fields if value != vars(scene).get(name))
            raise EpisodeError(
                f"{path}: this is an episode of another scene ({', '.join(differ)} differ); give"
                " the episode's scene, or another folder"
            )
        return episode

    def save(self, path: str | Path) -> None:
        """Write a NetCDF file atomically.

        Raises
        ------
        OutputError
            If it cannot be written there.
        """
        write_atomically(Path(path), lambda to: self.dataset.to_netcdf(to, engine="h5netcdf"))

    @property
    def scene(self) -> Scene:
        """Return the scene of the episode."""
        return Scene.from_toml(self.dataset.attrs["scene"])

    @property
    def agent(self) -> str:
        """Return the name of the agent."""
        return str(self.dataset.attrs["agent"])

    @property
    def seed(self) -> int:
        """Return the seed of the world and the agent."""
        return int(self.dataset.attrs["seed"])

    @property
    def reached(self) -> bool:
        """Return whether the goal was reached."""
        return bool(self.dataset.attrs["reached"])

    @property
    def steps(self) -> int:
        """Return the number of actions."""
        return int(self.dataset.sizes["interval"])

    @property
    def bumps(self) -> int:
        """Return the number of intervals in which a body touched a wall or another body."""
        return int(self.dataset["bumped"].sum())

    @property
    def added(self) -> list[dict[str, Any]]:
        """Return the added effects: ``effect``, ``body``, and ``transitions`` before."""
        return list(json.loads(self.dataset.attrs.get("added", "[]")))

    def rewards(self, steps: int) -> Floats:
        """Return the rewards at the start and so many steps, shape (steps + 1,), m.

        The last reward is repeated after the end of the episode.
        """
        rewards = self.dataset["reward"].to_numpy()[: steps + 1]
        return np.pad(rewards, (0, steps + 1 - len(rewards)), mode="edge")

    def history(self) -> History:
        """Return the transitions as the agent observed them: separate, one interval each.

        Raises
        ------
        HistoryError
            If no action was taken.
        """
        states = self.dataset["states"].to_numpy()
        action, observed = self.dataset["action"].to_numpy(), self.dataset["observed"].to_numpy()
        return from_segments(self.scene, states[:-1], action[:, None], observed[:, None])
