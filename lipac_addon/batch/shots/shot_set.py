"""One set of instances for a whole shot: whatever matters in any of its frames."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ....core.arrays import Records
from ....core.culling.options import State
from ....core.files.level import AnyLevel, Steps, finest
from ....core.files.report import States
from ...keys import KEY, Keys, Kind, packed


class ShotSet:
    """The instances of all frames that were added, found again from frame to frame by their keys.

    active: (N,) bool, those that were kept in one of the frames; met: (N,) bool, those that paths of one met, or that
    it keeps; `keys` belong to both. faces: by name of an object that no frame keeps as a whole, (F,) bool, faces that
    one of them keeps. levels: as of `States`, of objects that all frames which keep them have levels of: the finest.
    """

    def __init__(self) -> None:
        self.active: NDArray[np.bool_] = np.zeros(0, bool)
        self.met: NDArray[np.bool_] = np.zeros(0, bool)
        self._records: Records = np.zeros(0, KEY)
        self._names: dict[str, int] = {}
        self.faces: dict[str, NDArray[np.bool_]] = {}
        self.levels: dict[str, AnyLevel] = {}
        self._fine: set[str] = set()  # objects that a frame keeps as they are, or whose levels do not go together
        self._cut: set[str] = set()  # objects of which a frame keeps some faces: its level has those alone
        self._whole: set[str] = set()  # objects that a frame keeps with all faces

    @property
    def keys(self) -> Keys:
        """Of all instances, N of them."""
        return Keys(self._records, tuple(self._names))

    def add(self, states: States) -> None:
        """Take a frame in."""
        records = self.records_of(states)
        rows, known = self._rows(records)
        kept = states.state != State.CULLED
        met = kept | states.hits.any(axis=1)
        self.active[rows[known]] |= kept[known]
        self.met[rows[known]] |= met[known]
        if not known.all():
            self._records = np.concatenate([self._records, records[~known]])
            self.active, self.met = np.append(self.active, kept[~known]), np.append(self.met, met[~known])
        self._add_faces(states, kept)
        self._add_levels(states, kept)

    def _add_faces(self, states: States, kept: NDArray[np.bool_]) -> None:
        """Take in which faces of its objects a frame keeps; where these have other faces than before, all."""
        shown = np.unique(states.keys["object"][kept & (states.keys["kind"] == Kind.OBJECT)])
        self._whole.update({states.names[n] for n in shown.tolist() if n >= 0} - states.faces.keys())
        for name, mask in states.faces.items():
            if len(self.faces.get(name, mask)) != len(mask):
                self._whole.add(name)
            self.faces[name] = mask if name not in self.faces or name in self._whole else self.faces[name] | mask
        for name in self._whole & self.faces.keys():
            del self.faces[name]

    def _add_levels(self, states: States, kept: NDArray[np.bool_]) -> None:
        """Take in what takes the place of meshes in a frame."""
        shown = np.unique(states.keys["object"][kept])
        for name in {states.names[n] for n in shown[shown >= 0].tolist()} - self._fine:
            level = states.levels.get(name)
            if name in states.faces:
                self._cut.add(name)
            if level is not None and name in self.levels:
                level = finest(self.levels[name], level, name in self._cut)
            if level is None:
                self._fine.add(name)
                self.levels.pop(name, None)
            else:
                self.levels[name] = level

    def of(self, states: States) -> NDArray[np.bool_]:
        """Which of a frame's instances, (n,) bool, are active. Raises ValueError where the frame was not added."""
        return self.active[self.rows(states)]

    def rows(self, states: States) -> NDArray[np.intp]:
        """Which of `keys` each of a frame's instances is: (n,). Raises ValueError where the frame was not added."""
        rows, known = self._rows(self.records_of(states))
        if not known.all():
            raise ValueError("a frame with instances that were not added")
        return rows

    def found(self, keys: Keys) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which instances of a frame, added or not, are active, and which were met: (n,) bool each."""
        rows, known = self._rows(self._renamed(keys.names, {name: keys.records[name] for name in KEY.names or ()}))
        at = np.where(known, rows, 0)
        active, met = (known & of[at] if len(of) else known for of in (self.active, self.met))
        return active, met

    def faces_of(self, keys: Keys, active: NDArray[np.bool_]) -> dict[int, NDArray[np.bool_]]:
        """By row of an object that is active, (n,) bool, faces of it that are, (F,) bool, where those are some, and
        nothing takes the place of its mesh."""
        objects = np.flatnonzero(active & (keys.records["kind"] == Kind.OBJECT)).tolist()
        names = ((row, keys.names[keys.records["object"][row]]) for row in objects)
        named = ((row, self.faces.get(name)) for row, name in names if name not in self.levels)
        return {row: mask for row, mask in named if mask is not None and mask.any() and not mask.all()}

    @property
    def digest(self) -> str:
        """SHA-256 of a set: which instances there are, which of them and of their faces stay, and what takes the place
        of meshes."""
        faces = (part for name in sorted(self.faces) for part in (name.encode(), self.faces[name].tobytes()))
        levels = (part for name in sorted(self.levels) for part in (name.encode(), *_parts(self.levels[name])))
        names = "\0".join(self._names).encode()
        return hashlib.sha256(
            b"\0".join((packed(self._records).tobytes(), names, self.active.tobytes(), *faces, *levels))
        ).hexdigest()

    def records_of(self, states: States) -> Records:
        """The keys of a frame as records of KEY, by the names of `keys`."""
        return self._renamed(states.names, states.keys)

    def _renamed(self, names: Sequence[str], keys: Mapping[str, np.ndarray]) -> Records:
        place = np.array([*(self._names.setdefault(name, len(self._names)) for name in names), -1], np.int32)
        records = np.zeros(len(keys["kind"]), KEY)
        records["kind"], records["path"] = keys["kind"], -1
        records["path"][:, : keys["path"].shape[1]] = keys["path"]
        records["host"], records["object"] = place[keys["host"]], place[keys["object"]]
        return records

    def _rows(self, records: Records) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """For each record its row in this set, and whether it has one."""
        mine, theirs = packed(self._records), packed(records)
        if mine.tobytes() == theirs.tobytes():
            return np.arange(len(mine)), np.ones(len(mine), bool)
        if not len(mine):
            return np.zeros(len(theirs), np.intp), np.zeros(len(theirs), bool)
        order = np.argsort(mine)
        at = np.minimum(np.searchsorted(mine, theirs, sorter=order), len(mine) - 1)
        return order[at], mine[order[at]] == theirs


def _parts(level: AnyLevel) -> tuple[bytes, ...]:
    """All that a level is."""
    return (b"%d" % level.steps,) if isinstance(level, Steps) else (level.corners.tobytes(), level.faces.tobytes())
