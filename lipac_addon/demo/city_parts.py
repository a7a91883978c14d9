"""Buildings and street furniture of the demo city, as `Solid`s. Buildings: facade at y = 0 looking along -Y, 12 m wide,
12 m deep, foot at z = 0."""

from __future__ import annotations

import numpy as np

from .solids import F64, Solid

WIDTH = 12.0
DEPTH = 12.0
GROUND_FLOOR = 4.2
STOREY = 3.1

# Slots of a building's materials.
WALL, TRIM, GLASS, FRAME, ROOF, ACCENT = range(6)
# Slots of a car.
PAINT, CAR_GLASS, TYRE, CHROME = range(4)


def building(rng: np.random.Generator, storeys: int, bays: int, roof: str, balconies: bool, arched: bool) -> Solid:
    """A town house with `storeys` above a shop floor; `roof` is flat, mansard or gable; `arched` windows carry a
    stepped head."""
    s = Solid()
    eaves = GROUND_FLOOR + storeys * STOREY
    window = (min(1.5, WIDTH / bays * 0.5), 1.9)
    centres = (np.arange(bays) + 0.5) * (WIDTH / bays) - WIDTH / 2
    sills = GROUND_FLOOR + np.arange(storeys) * STOREY + 0.8
    _facade(s, centres, sills, window, eaves, detailed=True)
    _facade(s, centres, sills, window, eaves, detailed=False)
    _shop(s, rng)
    x, z = (a.ravel() for a in np.meshgrid(centres, sills))
    half = window[0] / 2
    if arched:
        for step, (rise, inset) in enumerate(((0.12, 0.0), (0.3, 0.18), (0.45, 0.45))):
            top = z + window[1] + rise
            s.boxes(
                _points(x - half - 0.18 + inset, -0.14 + 0.02 * step, z + window[1]),
                _points(x + half + 0.18 - inset, 0.02, top),
                TRIM,
            )
    else:
        s.boxes(
            _points(x - half - 0.2, -0.16, z + window[1]), _points(x + half + 0.2, 0.02, z + window[1] + 0.22), TRIM
        )
    if balconies:
        _balconies(s, x[bays:], z[bays:], half)
    for k in range(1, storeys):  # a string course between storeys
        y = GROUND_FLOOR + k * STOREY
        s.boxes((-WIDTH / 2, -0.07, y), (WIDTH / 2, 0.02, y + 0.16), TRIM)
    _cornice(s, eaves)
    {"flat": _flat_roof, "mansard": _mansard_roof, "gable": _gable_roof}[roof](s, rng, eaves, centres)
    return s


def _points(x: F64, y: float | F64, z: F64) -> F64:
    return np.stack(np.broadcast_arrays(x, y, z), 1)


def _rectangles(x0: F64, x1: F64, z0: F64, z1: F64, y: float | F64, back: bool = False) -> F64:
    """Rectangles at constant y that look along -Y (or +Y)."""
    a, b = (x1, x0) if back else (x0, x1)
    return np.stack([_points(a, y, z0), _points(b, y, z0), _points(b, y, z1), _points(a, y, z1)], 1)


def _facade(s: Solid, centres: F64, sills: F64, window: tuple[float, float], eaves: float, detailed: bool) -> None:
    """Wall with a recess, a pane and, in front, sash bars and a sill at every window; the sides are blank party
    walls."""
    back = not detailed
    face, depth = (DEPTH, -0.28) if back else (0.0, 0.28)
    half = window[0] / 2
    xs = np.sort(np.concatenate([[-WIDTH / 2, WIDTH / 2], centres - half, centres + half]))
    foot = 0.0 if back else GROUND_FLOOR
    zs = np.sort(np.concatenate([[foot, eaves], sills, sills + window[1]]))
    i, k = (a.ravel() for a in np.meshgrid(np.arange(len(xs) - 1), np.arange(len(zs) - 1)))
    hole = (i % 2 == 1) & (k % 2 == 1)
    s.quads(_rectangles(xs[i], xs[i + 1], zs[k], zs[k + 1], face, back)[~hole], WALL)
    x0, x1, z0, z1 = xs[i][hole], xs[i + 1][hole], zs[k][hole], zs[k + 1][hole]
    inner = face + depth
    s.quads(_rectangles(x0, x1, z0, z1, inner, back), GLASS)
    rim = (x0, x1, z0, z1)
    for c in range(4):  # the four faces of the recess
        ax, az = rim[(0, 1, 1, 0)[c]], rim[(2, 2, 3, 3)[c]]
        bx, bz = rim[(1, 1, 0, 0)[c]], rim[(2, 3, 3, 2)[c]]
        strip = np.stack(
            [_points(ax, face, az), _points(bx, face, bz), _points(bx, inner, bz), _points(ax, inner, az)], 1
        )
        s.quads(strip[:, ::-1] if back else strip, TRIM)
    if back:
        low, high = -WIDTH / 2, WIDTH / 2
        left = [(low, DEPTH, 0.0), (low, 0.0, 0.0), (low, 0.0, eaves), (low, DEPTH, eaves)]
        right = [(high, 0.0, 0.0), (high, DEPTH, 0.0), (high, DEPTH, eaves), (high, 0.0, eaves)]
        s.quads(np.array([left, right]), WALL)
        return
    bar, near, far = 0.09, inner - 0.1, inner + 0.01
    middle = (x0 + x1) / 2
    transom = z0 + (z1 - z0) * 0.66
    for a, b, c, d in (
        (x0, x0 + bar, z0, z1),
        (x1 - bar, x1, z0, z1),
        (x0, x1, z0, z0 + bar),
        (x0, x1, z1 - bar, z1),
        (middle - bar / 2, middle + bar / 2, z0, z1),
        (x0, x1, transom - bar / 2, transom + bar / 2),
    ):
        s.boxes(_points(a, near, c), _points(b, far, d), FRAME)
    s.boxes(_points(x0 - 0.12, -0.2, z0 - 0.14), _points(x1 + 0.12, 0.05, z0), TRIM)


def _shop(s: Solid, rng: np.random.Generator) -> None:
    """Shop floor: plinth, piers, display windows, a door, sign band and an awning."""
    top = GROUND_FLOOR - 0.75
    s.boxes((-WIDTH / 2, -0.12, 0.0), (WIDTH / 2, 0.3, 0.45), TRIM)
    s.boxes((-WIDTH / 2, -0.1, top), (WIDTH / 2, 0.3, GROUND_FLOOR - 0.15), ACCENT)
    s.boxes((-WIDTH / 2, -0.3, GROUND_FLOOR - 0.15), (WIDTH / 2, 0.3, GROUND_FLOOR + 0.05), TRIM)
    piers = np.linspace(-WIDTH / 2, WIDTH / 2 - 0.6, 4)
    s.boxes(_points(piers, -0.14, np.zeros(4)), _points(piers + 0.6, 0.3, np.full(4, top)), WALL)
    x0, x1 = piers[:-1] + 0.6, piers[1:]
    s.quads(_rectangles(x0, x1, np.full(3, 0.3), np.full(3, top), 0.25), GLASS)
    middle = (x0 + x1) / 2
    for a, b in ((x0, x0 + 0.1), (x1 - 0.1, x1), (middle - 0.05, middle + 0.05)):
        s.boxes(_points(a, 0.1, np.full(3, 0.45)), _points(b, 0.26, np.full(3, top)), FRAME)
    s.boxes(_points(x0, 0.1, np.full(3, 2.5)), _points(x1, 0.26, np.full(3, 2.6)), FRAME)
    door = int(rng.integers(3))
    s.boxes((middle[door] - 0.6, 0.05, 0.0), (middle[door] + 0.6, 0.3, 2.5), ACCENT)
    stripes = 9  # an awning of alternating cloth
    bay = (door + 1) % 3
    edges = np.linspace(x0[bay] - 0.2, x1[bay] + 0.2, stripes + 1)
    for k in range(stripes):
        a, b = edges[k], edges[k + 1]
        cloth = ACCENT if k % 2 else FRAME
        top_cloth = [[a, -1.3, 2.55], [b, -1.3, 2.55], [b, -0.12, 3.3], [a, -0.12, 3.3]]
        valance = [[a, -1.3, 2.3], [b, -1.3, 2.3], [b, -1.3, 2.55], [a, -1.3, 2.55]]
        s.quads(np.array([top_cloth, valance]), cloth)


def _balconies(s: Solid, x: F64, z: F64, half: float) -> None:
    low = z - 0.25
    s.boxes(_points(x - half - 0.35, -0.85, low), _points(x + half + 0.35, 0.0, low + 0.14), TRIM)
    for rail in (0.95, 0.2):
        s.boxes(_points(x - half - 0.35, -0.85, low + rail), _points(x + half + 0.35, -0.8, low + rail + 0.05), ROOF)
    for t in np.linspace(-1, 1, 9):
        at = x + t * (half + 0.31)
        s.boxes(_points(at - 0.015, -0.84, low + 0.14), _points(at + 0.015, -0.81, low + 0.95), ROOF)


def _cornice(s: Solid, eaves: float) -> None:
    for rise, out in ((-0.5, 0.12), (-0.2, 0.4), (0.0, 0.55)):
        s.boxes((-WIDTH / 2, -out, eaves + rise), (WIDTH / 2, 0.1, eaves + rise + 0.22), TRIM)
    at = np.arange(-WIDTH / 2 + 0.2, WIDTH / 2, 0.6)
    s.boxes(
        _points(at, -0.34, np.full(len(at), eaves - 0.42)), _points(at + 0.25, 0.0, np.full(len(at), eaves - 0.2)), TRIM
    )


def _chimneys(s: Solid, rng: np.random.Generator, z: float, height: float) -> None:
    for x in (-WIDTH / 2 + 0.5, WIDTH / 2 - 1.3):
        y = rng.uniform(3, 7)
        s.boxes((x, y, z), (x + 0.8, y + 1.6, z + height), WALL)
        s.boxes((x - 0.08, y - 0.08, z + height), (x + 0.88, y + 1.68, z + height + 0.15), TRIM)
        for pot in (0.15, 0.7, 1.25):
            s.column((x + 0.4, y + pot, z + height + 0.15), (0.14, 0.11), 0.5, ACCENT, 6)


def _flat_roof(s: Solid, rng: np.random.Generator, eaves: float, centres: F64) -> None:
    low, high = -WIDTH / 2, WIDTH / 2
    s.quads([[[low, 0, eaves], [high, 0, eaves], [high, DEPTH, eaves], [low, DEPTH, eaves]]], ROOF)
    for a, b in (
        ((low, 0, eaves), (high, 0.3, eaves + 0.9)),
        ((low, DEPTH - 0.3, eaves), (high, DEPTH, eaves + 0.9)),
        ((low, 0.3, eaves), (low + 0.25, DEPTH - 0.3, eaves + 0.9)),
        ((high - 0.25, 0.3, eaves), (high, DEPTH - 0.3, eaves + 0.9)),
    ):
        s.boxes(a, b, WALL)
    x = rng.uniform(-3, 0)
    s.boxes((x, 5, eaves), (x + 3, 8, eaves + 2.2), WALL)
    s.boxes((x - 0.15, 4.85, eaves + 2.2), (x + 3.15, 8.15, eaves + 2.35), TRIM)
    _chimneys(s, rng, eaves, 1.8)


def _mansard_roof(s: Solid, rng: np.random.Generator, eaves: float, centres: F64) -> None:
    low, high, knee = -WIDTH / 2, WIDTH / 2, eaves + 2.8

    def ring(y0: float, y1: float, z: float) -> list[tuple[float, float, float]]:
        return [(low, y0, z), (high, y0, z), (high, y1, z), (low, y1, z)]

    s.frustum(ring(0, DEPTH, eaves + 0.2), ring(1.2, DEPTH - 1.2, knee), ROOF)
    s.frustum(ring(1.2, DEPTH - 1.2, knee), ring(5, 7, knee + 1.1), ROOF)
    n = len(centres)
    z = np.full(n, eaves + 0.3)
    s.boxes(_points(centres - 0.75, 0.25, z), _points(centres + 0.75, 3.0, z + 2.0), TRIM)
    s.boxes(_points(centres - 0.9, 0.1, z + 2.0), _points(centres + 0.9, 3.0, z + 2.2), ROOF)
    s.quads(_rectangles(centres - 0.5, centres + 0.5, z + 0.3, z + 1.8, 0.24), GLASS)
    for a, b in ((-0.5, -0.42), (0.42, 0.5), (-0.04, 0.04)):
        s.boxes(_points(centres + a, 0.18, z + 0.3), _points(centres + b, 0.25, z + 1.8), FRAME)
    _chimneys(s, rng, knee, 2.2)


def _gable_roof(s: Solid, rng: np.random.Generator, eaves: float, centres: F64) -> None:
    low, high, ridge = -WIDTH / 2, WIDTH / 2, eaves + 3.6
    s.quads(
        [
            [[low, -0.5, eaves + 0.1], [high, -0.5, eaves + 0.1], [high, DEPTH / 2, ridge], [low, DEPTH / 2, ridge]],
            [
                [high, DEPTH + 0.5, eaves + 0.1],
                [low, DEPTH + 0.5, eaves + 0.1],
                [low, DEPTH / 2, ridge],
                [high, DEPTH / 2, ridge],
            ],
        ],
        ROOF,
    )
    for x, flip in ((low, True), (high, False)):
        gable = np.array([[x, 0, eaves], [x, DEPTH, eaves], [x, DEPTH / 2, ridge]], float)
        s.add(gable[::-1] if flip else gable, np.array([[0, 1, 2]]), WALL)
    tile = np.linspace(0.1, 0.92, 14)[:, None]  # courses of tiles, as thin steps
    for y0, direction in ((-0.5, 1.0), (DEPTH + 0.5, -1.0)):
        y = y0 + direction * tile[:, 0] * (DEPTH / 2 + 0.5)
        z = eaves + 0.1 + tile[:, 0] * (ridge - eaves - 0.1)
        s.boxes(_points(np.full(14, low), y - 0.05, z - 0.05), _points(np.full(14, high), y + 0.05, z + 0.06), ROOF)
    _chimneys(s, rng, ridge - 1.6, 2.6)


def lamp() -> Solid:
    """Street lamp, 5.2 m; arm along +X. Slots: iron, glass."""
    s = Solid()
    s.column((0, 0, 0), (0.2, 0.14), 0.5, 0)
    s.column((0, 0, 0.5), (0.08, 0.05), 4.4, 0)
    s.boxes((0.0, -0.03, 4.75), (0.8, 0.03, 4.83), 0)
    for z, r0, r1, h, slot in ((4.15, 0.1, 0.2, 0.45, 1), (4.6, 0.26, 0.08, 0.18, 0), (4.05, 0.08, 0.1, 0.1, 0)):
        s.column((0.8, 0, z), (r0, r1), h, slot, 6)
    for z in (1.2, 3.4):
        s.column((0, 0, z), (0.11, 0.11), 0.12, 0)
    return s


def tree(rng: np.random.Generator, height: float, leaves: int) -> Solid:
    """Broad-leaved tree in a grating. Slots: bark, leaves, iron."""
    s = Solid()
    s.boxes((-0.8, -0.8, 0.0), (0.8, 0.8, 0.04), 2)
    s.column((0, 0, 0), (0.2, 0.13), height * 0.5, 0)
    for _ in range(5):
        tip = np.array([rng.uniform(-1, 1), rng.uniform(-1, 1), height * rng.uniform(0.65, 0.85)])
        foot = np.array([[-0.06, -0.06, 0], [0.06, -0.06, 0], [0.06, 0.06, 0], [-0.06, 0.06, 0]]) + np.array(
            [0, 0, height * 0.42]
        )
        s.frustum(foot, foot * (0.4, 0.4, 0) + tip, 0)
    blobs = 7
    for k in range(blobs):
        c = (
            (rng.uniform(-1.1, 1.1), rng.uniform(-1.1, 1.1), height * rng.uniform(0.55, 0.9))
            if k
            else (0, 0, height * 0.7)
        )
        r = height * rng.uniform(0.14, 0.2) if k else height * 0.24
        s.leaves(rng, c, (r, r, r * 0.85), leaves // blobs, 0.11, 1)
    return s


def car(van: bool) -> Solid:
    """Parked car along X, 4.3 m (a van is taller). Slots: paint, glass, tyre, chrome."""
    s = Solid()
    roof = 2.0 if van else 1.42

    def ring(x0: float, x1: float, half: float, z: float) -> list[tuple[float, float, float]]:
        return [(x0, -half, z), (x1, -half, z), (x1, half, z), (x0, half, z)]

    s.frustum(ring(-2.1, 2.1, 0.8, 0.25), ring(-2.15, 2.15, 0.88, 0.55), PAINT)
    s.frustum(ring(-2.15, 2.15, 0.88, 0.55), ring(-2.05, 2.0, 0.84, 0.92), PAINT)
    front, back = ((1.35, 1.75), (-2.0, -2.0)) if van else ((0.6, 1.25), (-1.35, -1.85))
    s.frustum(ring(back[1], front[1], 0.82, 0.92), ring(back[0], front[0], 0.66, roof), CAR_GLASS, cap=PAINT)
    s.boxes((back[0] - 0.05, -0.69, roof - 0.04), (front[0] + 0.05, 0.69, roof + 0.04), PAINT)
    # pillars
    for x in (back[1] * 0.5 + back[0] * 0.5, front[0] * 0.35 + back[0] * 0.65, front[0] * 0.5 + front[1] * 0.5):
        s.boxes((x - 0.06, -0.79, 0.9), (x + 0.06, 0.79, roof - 0.02), PAINT)
    for x in (-1.35, 1.3):
        for y in (-0.9, 0.68):
            s.column((x, y, 0.33), (0.33, 0.33), 0.22, TYRE, 16, axis=1)
            s.column((x, y - 0.01, 0.33), (0.18, 0.18), 0.24, CHROME, 10, axis=1)
    for x in (-2.2, 2.12):
        s.boxes((x, -0.85, 0.36), (x + 0.08, 0.85, 0.5), CHROME)
    for y in (-0.75, 0.45):
        s.boxes((2.1, y, 0.62), (2.17, y + 0.3, 0.78), CHROME)
    return s


def bench() -> Solid:
    """Park bench, seat towards -Y. Slots: wood, iron."""
    s = Solid()
    for k in range(5):
        s.boxes((-0.9, -0.28 + k * 0.11, 0.44), (0.9, -0.19 + k * 0.11, 0.48), 0)
    for k in range(4):
        s.boxes((-0.9, 0.3 + 0.03 * k, 0.56 + k * 0.12), (0.9, 0.34 + 0.03 * k, 0.65 + k * 0.12), 0)
    for x in (-0.75, 0.0, 0.7):
        for y in (-0.28, 0.26):
            s.boxes((x, y, 0.0), (x + 0.05, y + 0.05, 0.44), 1)
        s.boxes((x, -0.3, 0.4), (x + 0.05, 0.3, 0.44), 1)
        s.boxes((x, 0.28, 0.4), (x + 0.05, 0.36, 1.0), 1)
    return s


def planter(rng: np.random.Generator) -> Solid:
    """Stone tub with a clipped bush. Slots: stone, leaves."""
    s = Solid()
    s.column((0, 0, 0), (0.42, 0.55), 0.6, 0, 12)
    s.column((0, 0, 0.55), (0.6, 0.6), 0.1, 0, 12)
    s.leaves(rng, (0, 0, 1.05), (0.5, 0.5, 0.5), 260, 0.08, 1)
    return s


def clock_tower() -> Solid:
    """Landmark, 46 m. Slots as a building's."""
    s = Solid()
    s.boxes((-4, -4, 0), (4, 4, 32), WALL)
    for z in (8, 16, 24, 32, 37):
        s.boxes((-4.4, -4.4, z), (4.4, 4.4, z + 0.6), TRIM)
    for corner in ((-4.2, -4.2), (3.4, -4.2), (-4.2, 3.4), (3.4, 3.4)):
        s.boxes((*corner, 0), (corner[0] + 0.8, corner[1] + 0.8, 38), TRIM)
    s.boxes((-3.6, -3.6, 32.6), (3.6, 3.6, 37), WALL)
    for sill in (10.5, 18.5, 26.5):
        for t in (-2.2, -0.6, 1.0):
            s.boxes((t, -4.06, sill), (t + 1.2, 4.06, sill + 3.4), GLASS)
            s.boxes((-4.06, t, sill), (4.06, t + 1.2, sill + 3.4), GLASS)
    for axis, at in ((1, -4.2), (1, 4.05), (0, -4.2), (0, 4.05)):
        centre = [0.0, 0.0, 34.8]
        centre[axis] = at
        s.column(centre, (2.1, 2.1), 0.15, TRIM, 32, axis)
        centre[axis] = at - 0.04
        s.column(centre, (1.85, 1.85), 0.23, FRAME, 32, axis)
    for front in (-4.32, 4.22):
        s.boxes((-0.1, front, 34.8), (0.1, front + 0.1, 36.3), ROOF)
        s.boxes((-0.1, front, 34.7), (1.1, front + 0.1, 34.9), ROOF)
    base = np.array([[-4.4, -4.4, 37.6], [4.4, -4.4, 37.6], [4.4, 4.4, 37.6], [-4.4, 4.4, 37.6]])
    s.frustum(base, base * (0.35, 0.35, 0) + np.array([0, 0, 43]), ROOF)
    s.frustum(base * (0.35, 0.35, 0) + np.array([0, 0, 43]), base * (0.01, 0.01, 0) + np.array([0, 0, 50]), ACCENT)
    return s
