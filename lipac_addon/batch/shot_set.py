"""One set of instances for a whole shot: whatever matters in any of its frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Records
from ...core.culling.options import State
from ...core.files.report import States
from ..keys import KEY, Keys, Kind, packed


class ShotSet:
    """The instances of all frames that were added, found again from frame to frame by their keys.

    active: (N,) bool, those that were kept in one of the frames; `keys` belong to it. faces: by name of an object that
    no frame keeps as a whole, (F,) bool, faces that one of them keeps.
    """

    def __init__(self) -> None:
        self.active: NDArray[np.bool_] = np.zeros(0, bool)
        self._records: Records = np.zeros(0, KEY)
        self._names: dict[str, int] = {}
        self.faces: dict[str, NDArray[np.bool_]] = {}
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
        self.active[rows[known]] |= kept[known]
        if not known.all():
            self._records = np.concatenate([self._records, records[~known]])
            self.active = np.concatenate([self.active, kept[~known]])
        self._add_faces(states, kept)

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

    def of(self, states: States) -> NDArray[np.bool_]:
        """Which of a frame's instances, (n,) bool, are active. Raises ValueError where the frame was not added."""
        return self.active[self.rows(states)]

    def rows(self, states: States) -> NDArray[np.intp]:
        """Which of `keys` each of a frame's instances is: (n,). Raises ValueError where the frame was not added."""
        rows, known = self._rows(self.records_of(states))
        if not known.all():
            raise ValueError("a frame with instances that were not added")
        return rows

    def records_of(self, states: States) -> Records:
        """The keys of a frame as records of KEY, by the names of `keys`."""
        place = np.array([*(self._names.setdefault(name, len(self._names)) for name in states.names), -1], np.int32)
        records = np.zeros(len(states.state), KEY)
        records["kind"], records["path"] = states.keys["kind"], -1
        records["path"][:, : states.keys["path"].shape[1]] = states.keys["path"]
        records["host"], records["object"] = place[states.keys["host"]], place[states.keys["object"]]
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
