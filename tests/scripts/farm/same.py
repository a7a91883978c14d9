"""Whether two folders hold the same shot."""

from __future__ import annotations

import numpy as np

from lipac.core.files.report import load_states
from lipac.lipac_addon.farm.layout import FarmShot, read_json
from lipac.lipac_addon.pictures import read_picture


def assert_same_shot(a: FarmShot, b: FarmShot) -> None:
    """The same states, set and pictures, bit for bit; nothing that was begun and not ended is left."""
    assert (read_json(a.united) or {})["set"] == (read_json(b.united) or {})["set"]
    for frame in a.frames:
        one, other = (load_states(shot.analysis(frame)) for shot in (a, b))
        for name in ("state", "score", "hits"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        np.testing.assert_array_equal(read_picture(a.picture(frame)), read_picture(b.picture(frame)))
    assert not [path for shot in (a, b) for path in shot.folder.rglob(".*.part*")]
