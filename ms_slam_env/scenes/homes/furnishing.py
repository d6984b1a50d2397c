"""Furniture of each kind of room."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from ms_slam_env.scenes.furniture import decor, fittings, pieces, small_things
from ms_slam_env.scenes.homes.arrangement import Furnisher, Spot
from ms_slam_env.scenes.textures import interior
from ms_slam_env.scenes.textures.noise import hsv

_TABLE_M = 0.74


def furnish(of: Furnisher) -> None:
    """Furnish a room by its kind; pictures, plants, curtains and switches come last."""
    _FURNISH[of.kind](of)
    _at_windows(of)
    _switches(of)
    if of.kind != "bathroom":
        _decorate(of)


def _living(of: Furnisher) -> None:
    """Sofa with a table, television, shelves, armchair, lamp; a kitchen if there is no other."""
    rng, build = of.rng, of.build
    if of.has_kitchen:
        _kitchen_line(of, 2.4)
    width = rng.uniform(1.8, 2.3)
    sofa = of.arrangement.stand(rng, (width, 0.96, 0.9), _inner_first(of), 0.05, before=1.0)
    if sofa is not None:
        with of.at(sofa):
            pieces.sofa(build, rng, width, 3 if width > 2.0 else 2)
        _rug_before(of, sofa, 1.5, rng.uniform(2.0, 2.5), rng.uniform(1.4, 1.6))
        _coffee_table(of, sofa)
        _television(of, sofa)
    lamp = of.arrangement.stand(rng, (0.46, 0.46, 1.6), of.walls(), in_corner=True)
    if lamp is not None:
        _shine(of, lamp, (0, -0.23, 0), lambda: decor.floor_lamp(build, 1.5, (250, 236, 205)))
    _shelves(of, int(rng.integers(1, 3)))
    if of.room.size[0] * of.room.size[1] > 19.0:
        _dining(of)
    _put(of, (0.85, 0.96, 0.9), lambda: pieces.sofa(build, rng, 0.85, 1, "armchair"), gap=0.12)
    _chest(of)
    _plant(of)


def _kitchen(of: Furnisher) -> None:
    """A row of units with cupboards above, refrigerator, table with chairs, shelf."""
    longest = max(of.room.size[:2])
    _kitchen_line(of, min(longest - 0.8, of.rng.uniform(2.4, 3.2)))
    _dining(of)
    _put(of, (0.95, 0.32, 2.0), lambda: pieces.bookshelf(of.build, of.rng, 0.95, 1.9, 5, "shelves"))
    _hang_shelf(of)
    _plant(of)


def _bedroom(of: Furnisher) -> None:
    """Double bed between bedside tables with lamps, wardrobe, chest of drawers, chair."""
    _bed(of, of.rng.uniform(1.5, 1.8))
    width = float(of.rng.choice([1.0, 1.5, 2.0]))
    _wardrobe(of, width)
    _chest(of)
    _put(of, (0.46, 0.48, 0.95), lambda: pieces.chair(of.build, of.rng))
    _plant(of)


def _nursery(of: Furnisher) -> None:
    """Child's bed, desk, low shelf, toy box, toys on the rug."""
    build, rng = of.build, of.rng
    _bed(of, 0.95)
    _wardrobe(of, 1.0)
    _desk(of)
    _put(of, (0.95, 0.32, 1.3), lambda: pieces.bookshelf(build, rng, 0.95, 1.25, 3, "bookshelf"))
    _put(of, (0.62, 0.42, 0.4), lambda: pieces.toy_box(build, rng))
    middle = of.arrangement.in_the_room(rng, (0.5, 0.5))
    if middle is not None:
        with build.frame((*middle, 0.0)):
            for k in range(5):
                with build.frame((*rng.uniform(-0.2, 0.2, 2), 0.0)):
                    pieces.toy(build, rng, f"toy {k}")


def _study(of: Furnisher) -> None:
    """Desk with a laptop, bookshelves, armchair, chest of drawers."""
    _desk(of)
    _shelves(of, 2)
    _put(of, (0.85, 0.96, 0.9), lambda: pieces.sofa(of.build, of.rng, 0.85, 1, "armchair"), gap=0.1)
    _chest(of)
    _plant(of)


def _bathroom(of: Furnisher) -> None:
    """Bath, washbasin under a cabinet, toilet, washing machine, towels."""
    build, rng = of.build, of.rng
    front = small_things.wood(build, rng, (0.8, 0.8))
    bath = of.arrangement.stand(rng, (1.7, 0.75, 0.6), of.walls(), 0.0, 0.3, in_corner=True)
    if bath is not None:
        with of.at(bath):
            fittings.bath(build)
    basin = of.arrangement.stand(rng, (0.65, 0.48, 1.9), of.walls(), 0.0, 0.4)
    if basin is not None:
        with of.at(basin):
            fittings.washbasin(build, rng, front)
        with of.at(basin, 1.55):
            fittings.mirror_cabinet(build, front)
    _put(of, (0.6, 0.68, 0.82), lambda: fittings.toilet(build), gap=0.0)
    _put(of, (0.62, 0.6, 0.88), lambda: fittings.washing_machine(build))
    for k in range(2):
        rail = of.arrangement.hang(rng, (0.62, 0.6), 1.1, of.walls(), depth=0.1)
        if rail is not None:
            with of.at(rail, 1.35):
                fittings.towel_rail(build, rng, f"towel {k}")
    with build.frame((of.room.size[0] / 2, of.room.size[1] / 2, 0)):
        decor.rug(build, rng, 0.9, 0.6)


def _hall(of: Furnisher) -> None:
    """Coats, chests of drawers, narrow shelves and rugs, one every few metres."""
    build, rng = of.build, of.rng
    rack = of.arrangement.hang(rng, (1.0, 1.1), 1.3, of.walls(), depth=0.2)
    if rack is not None:
        with of.at(rack, 1.72):
            pieces.coat_rack(build, rng, 0.95)
    w, d, _ = of.room.size
    count = max(1, round(max(w, d) / 4.0))
    for k in range(count):
        with build.part(f"{k}"):
            _chest(of)
        draw = partial(pieces.bookshelf, build, rng, 0.7, 1.8, 4, f"bookshelf {k}")
        _put(of, (0.7, 0.32, 2.0), draw)
        along = (k + 0.5) * max(w, d) / count
        long = min(rng.uniform(1.8, 2.6), max(w, d) / count - 0.4)
        place = (along, d / 2, 0) if w > d else (w / 2, along, 0)
        with build.part(f"{k}"), build.frame(place, 0.0 if w > d else np.pi / 2):
            decor.rug(build, rng, long, 0.8)


_FURNISH: dict[str, Callable[[Furnisher], None]] = {
    "living": _living,
    "kitchen": _kitchen,
    "bedroom": _bedroom,
    "nursery": _nursery,
    "study": _study,
    "bathroom": _bathroom,
    "hall": _hall,
}


def _put(
    of: Furnisher,
    size: tuple[float, float, float],
    draw: Callable[[], object],
    gap: float = 0.02,
    before: float = 0.35,
) -> Spot | None:
    """Place an object at any wall, if there is room."""
    spot = of.arrangement.stand(of.rng, size, of.walls(), gap, before)
    if spot is not None:
        with of.at(spot):
            draw()
    return spot


def _inner_first(of: Furnisher) -> list[int]:
    """Walls without a window, then those with one."""
    return sorted(of.walls(), key=lambda wall: wall in of.windows)


def _shine(
    of: Furnisher, spot: Spot, at: tuple[float, float, float], draw: Callable[[], float]
) -> None:
    """Add a lamp in a spot's frame, and its bulb to those of the room."""
    with of.at(spot), of.build.frame(at):
        height = draw()
    x, y, z = at
    of.bulbs.append(of.room.to_world(spot.wall, (spot.along + x, y - spot.gap, z + height)))


def _rug_before(of: Furnisher, spot: Spot, away: float, width: float, depth: float) -> None:
    """A rug with its centre ``away`` metres from a spot's wall, no wider than the room there."""
    room = of.room
    half = room.length(spot.wall) / 2
    low, high = max(-half + 0.1, spot.along - width / 2), min(half - 0.1, spot.along + width / 2)
    far = min(away + depth / 2, room.size[1 - spot.wall % 2] - 0.1)
    near = away - depth / 2
    with of.at(Spot(spot.wall, (low + high) / 2, (near + far) / 2)):
        decor.rug(of.build, of.rng, high - low, far - near)


def _coffee_table(of: Furnisher, sofa: Spot) -> None:
    build, rng = of.build, of.rng
    width, depth, height = rng.uniform(0.9, 1.2), rng.uniform(0.5, 0.65), 0.42
    middle = of.room.to_world(sofa.wall, (sofa.along, -1.35 - depth / 2, 0))[:2]
    across = (width, depth) if sofa.wall % 2 == 0 else (depth, width)
    if not of.arrangement.take(middle, across):
        return
    board = small_things.wood(build, rng, (0.9, 0.9))
    with of.at(Spot(sofa.wall, sofa.along, 0.0)), build.frame((0, -1.35, 0.012)):
        pieces.table(build, width, depth, height, board, "coffee table")
        things = (
            (0.17, lambda: small_things.lying_book(build, rng, "magazine", 0.012)),
            (0.15, lambda: small_things.bowl(build, rng, "bowl")),
            (0.055, lambda: small_things.cup(build, rng, "cup 0")),
            (0.055, lambda: small_things.cup(build, rng, "cup 1")),
            (0.15, lambda: small_things.lying_book(build, rng, "book", 0.03)),
        )
        _scatter(of, (-width / 2, -depth), (width / 2, 0.0), height, things)


def _scatter(
    of: Furnisher,
    low: tuple[float, float],
    high: tuple[float, float],
    z: float,
    things: Sequence[tuple[float, Callable[[], object]]],
) -> None:
    """Place objects of given radii on a rectangle at height ``z``, without overlap."""
    spots = pieces.place(of.rng, low, high, [radius for radius, _ in things])
    for spot, (_, draw) in zip(spots, things, strict=True):
        if spot is not None:
            with of.build.frame((*spot, z)):
                draw()


def _television(of: Furnisher, sofa: Spot) -> None:
    """Television on its stand opposite the sofa, or anywhere else."""
    build, rng = of.build, of.rng
    width = rng.uniform(1.2, 1.5)
    walls = [(sofa.wall + 2) % 4, *of.walls()]
    spot = of.arrangement.stand(rng, (width, 0.48, 1.3), walls, before=0.4, near=-sofa.along)
    if spot is not None:
        with of.at(spot):
            top = pieces.tv_stand(build, rng, width)
            with build.frame((0, 0, top)):
                small_things.television(build, rng, min(width, rng.uniform(0.95, 1.2)))


def _shelves(of: Furnisher, count: int) -> None:
    for k in range(count):
        height = of.rng.uniform(1.75, 2.1)
        draw = partial(pieces.bookshelf, of.build, of.rng, 0.95, height, 5, f"bookshelf {k}")
        _put(of, (0.96, 0.32, height), draw, gap=0.01)


def _chest(of: Furnisher) -> None:
    """Chest of drawers with a vase and a book on it."""
    build, rng = of.build, of.rng
    height = rng.uniform(0.75, 0.9)
    spot = of.arrangement.stand(rng, (0.8, 0.48, height + 0.3), of.walls(), 0.01, 0.35)
    if spot is None:
        return
    with of.at(spot):
        pieces.drawers(build, rng, 0.8, height, "chest of drawers")
        with build.frame((-0.22, -0.2, height)):
            small_things.vase(build, rng, 0.28, "vase")
        with build.frame((0.2, -0.22, height)):
            small_things.lying_book(build, rng, "book on drawers", 0.04)


def _dining(of: Furnisher) -> None:
    """A table in the room with two to four chairs at it, laid with plates and cups."""
    build, rng = of.build, of.rng
    width, depth = float(rng.choice([1.2, 0.8])), 0.8
    around = (width, depth + 1.0)
    yaw = float(rng.choice([0.0, np.pi / 2]))
    for turn in (yaw, np.pi / 2 - yaw):
        across = around if turn == 0.0 else around[::-1]
        middle = of.arrangement.in_the_room(rng, across)
        if middle is None:
            continue
        board = small_things.wood(build, rng, (0.9, 0.9))
        with build.frame((*middle, 0), turn):
            with build.frame((0, depth / 2, 0)):
                pieces.table(build, width, depth, _TABLE_M, board, "dining table")
            _laid(of, width, depth)
            for k, x in enumerate([-0.3, 0.3] if width > 1.0 else [0.0]):
                for side in (0, 1):
                    y = (2 * side - 1) * (depth / 2 + 0.38)
                    place = (x + rng.uniform(-0.03, 0.03), y, 0)
                    with build.frame(place, np.pi * (1 - side) + rng.uniform(-0.12, 0.12)):
                        pieces.chair(build, rng, f"chair {k}.{side}")
        return


def _laid(of: Furnisher, width: float, depth: float) -> None:
    build, rng = of.build, of.rng
    things = (
        (0.15, lambda: small_things.bowl(build, rng, "bowl")),
        (0.14, lambda: small_things.plate(build, rng, "plate 0")),
        (0.14, lambda: small_things.plate(build, rng, "plate 1")),
        (0.05, lambda: small_things.bottle(build, rng, "bottle")),
        (0.06, lambda: small_things.cup(build, rng, "cup 0")),
        (0.06, lambda: small_things.cup(build, rng, "cup 1")),
    )
    half = (width / 2, depth / 2)
    _scatter(of, (-half[0], -half[1]), half, _TABLE_M, things)


def _kitchen_line(of: Furnisher, width: float) -> None:
    """Counter, with cupboards above if there is no window, and the refrigerator nearby."""
    build, rng = of.build, of.rng
    front = build.plain(hsv(rng.choice([0.1, 0.3, 0.55, 0.0]), rng.uniform(0.02, 0.3), 0.88))
    if rng.random() < 0.5:
        front = small_things.wood(build, rng, (0.9, 0.9))
    for wide in (width, 2.4, 1.8, 1.2):
        if wide > width:
            continue
        spot = of.arrangement.stand(
            rng, (wide, fittings.DEPTH_M, 1.0), of.walls(), 0.0, 0.6, in_corner=True
        )
        if spot is not None:
            break
    else:
        return
    with of.at(spot):
        fittings.counter(build, rng, wide, front)
        _on_counter(of, wide)
    _backsplash(of, spot, wide)
    for k, part in enumerate((0.6, 1.2, 0.6)):
        size, off = (part - 0.08, 0.7), (wide - part) / 2 + 0.02
        over = of.arrangement.hang(rng, size, 1.8, [spot.wall], spot.along, off, 0.37)
        if over is not None:
            with of.at(over, 1.45):
                fittings.wall_cupboard(build, part - 0.04, front, f"cupboard {k}")
    near = spot.along + np.sign(-spot.along) * (wide / 2 + 0.35)
    walls = [spot.wall, *of.walls()]
    fridge = of.arrangement.stand(rng, (0.62, 0.67, 1.85), walls, 0.0, 0.5, near=float(near))
    if fridge is not None:
        with of.at(fridge):
            fittings.refrigerator(build, rng)


def _backsplash(of: Furnisher, spot: Spot, wide: float) -> None:
    """Tiles on the wall over the worktop, up to the window if there is one."""
    window = of.windows.get(spot.wall)
    top = 1.45 if window is None else min(1.45, window.sill - 0.04)
    tone = hsv(of.rng.random(), of.rng.uniform(0.05, 0.4), of.rng.uniform(0.6, 0.9))
    glazed = of.build.material(interior.tiles(of.rng, tone), (0.6, 0.6))
    with of.at(spot), of.build.object("backsplash"):
        low = fittings.COUNTER_M
        of.build.quad((-wide / 2, -0.006, low), (wide, 0, 0), (0, 0, top - low), glazed)


def _on_counter(of: Furnisher, wide: float) -> None:
    """Bottles, bowl, pots between sink and hob."""
    build, rng = of.build, of.rng
    margin = wide / max(2, round(wide / 0.6)) + 0.02
    things: tuple[tuple[float, Callable[[], object]], ...] = (
        (0.15, lambda: small_things.bowl(build, rng, "fruit bowl")),
        (0.05, lambda: small_things.bottle(build, rng, "oil")),
        (0.06, lambda: small_things.pen_pot(build, rng, "ladles")),
        (0.05, lambda: small_things.cup(build, rng, "mug")),
        (0.12, lambda: small_things.vase(build, rng, 0.22, "jar")),
    )
    low, high = (-wide / 2 + margin, -0.5), (wide / 2 - margin, -0.04)
    _scatter(of, low, high, fittings.COUNTER_M, things)


def _bed(of: Furnisher, width: float) -> None:
    """A bed, head to a wall, bedside tables with lamps, a rug."""
    build, rng = of.build, of.rng
    size = (width + 0.1, pieces.BED_LENGTH_M + 0.04, 1.15)
    spot = of.arrangement.stand(rng, size, _inner_first(of), 0.01, 0.4)
    if spot is None:
        return
    with of.at(spot):
        pieces.bed(build, rng, width)
    _rug_before(of, spot, 1.75, width + 1.0, 1.3)
    for k, side in enumerate((-1, 1)):
        x = spot.along + side * (width / 2 + 0.36)
        size = (0.46, 0.48, 0.95)
        table = of.arrangement.stand(rng, size, [spot.wall], 0.01, near=x, off=0.15)
        if table is not None:
            with of.at(table):
                pieces.drawers(build, rng, 0.44, 0.5, f"bedside table {k}")
                with build.frame((0.1 * side, -0.35, 0.5)):
                    small_things.lying_book(build, rng, f"bedside book {k}", 0.03)
            lamp = partial(pieces.table_lamp, build, rng, 0.42, f"bedside lamp {k}")
            _shine(of, table, (0, -0.16, 0.5), lamp)


def _wardrobe(of: Furnisher, width: float) -> None:
    for wide in (width, 1.0):
        height = min(2.1, of.room.size[2] - 0.25)
        draw = partial(pieces.wardrobe, of.build, of.rng, wide, height)
        if _put(of, (wide + 0.04, 0.64, height + 0.05), draw, 0.01, 0.5) is not None:
            return


def _desk(of: Furnisher) -> None:
    """Desk at a wall, by the window if possible, with laptop, lamp, papers, and a chair."""
    build, rng = of.build, of.rng
    width, depth = rng.uniform(1.1, 1.4), 0.65
    walls = sorted(of.walls(), key=lambda wall: wall not in of.windows)
    spot = of.arrangement.stand(rng, (width, depth + 0.55, 0.75), walls, 0.02, 0.2)
    if spot is None:
        return
    board = small_things.wood(build, rng, (0.9, 0.9))
    with of.at(spot):
        pieces.table(build, width, depth, _TABLE_M, board, "desk")
        with build.frame((rng.uniform(-0.1, 0.1), -0.18, _TABLE_M)):
            small_things.laptop(build, rng, "laptop")
        things = (
            (0.17, lambda: small_things.paper(build, rng, "page")),
            (0.05, lambda: small_things.pen_pot(build, rng, "pens")),
            (0.05, lambda: small_things.cup(build, rng, "cup")),
        )
        _scatter(of, (0.18, -depth), (width / 2, -0.06), _TABLE_M, things)
        turn = np.pi + rng.uniform(-0.2, 0.2)
        with build.frame((rng.uniform(-0.1, 0.1), -depth - 0.36, 0), turn):
            pieces.chair(build, rng, "desk chair")
    side = (-width / 2 + 0.18, -0.2, _TABLE_M)
    _shine(of, spot, side, lambda: pieces.table_lamp(build, rng, 0.45, "desk lamp"))


def _plant(of: Furnisher) -> None:
    """A plant in a corner."""
    height = of.rng.uniform(0.8, 1.1)
    size = (0.8 * height, 0.8 * height, height)
    spot = of.arrangement.stand(of.rng, size, of.walls(), 0.06, in_corner=True)
    if spot is not None:
        with of.at(spot), of.build.frame((0, -0.4 * height, 0)):
            decor.plant(of.build, of.rng, height, "plant")


def _hang_shelf(of: Furnisher) -> None:
    """A shelf on the wall with books and an ornament."""
    spot = of.arrangement.hang(of.rng, (0.9, 0.5), 1.5, of.walls(), depth=0.25)
    if spot is not None:
        with of.at(spot, 1.38):
            pieces.wall_shelf(of.build, of.rng, 0.85)


def _decorate(of: Furnisher) -> None:
    """Pictures on the free sections of the walls, a shelf."""
    build, rng = of.build, of.rng
    if of.kind in ("living", "study", "nursery", "bedroom"):
        _hang_shelf(of)
    area = of.room.size[0] * of.room.size[1]
    for k in range(int(rng.integers(3, 5) + area / 6)):
        width, height = rng.uniform(0.4, 0.75), rng.uniform(0.4, 0.7)
        z = 1.6 + rng.uniform(-0.06, 0.06)
        spot = of.arrangement.hang(rng, (width + 0.15, height), z, of.walls())
        if spot is not None:
            with of.at(spot, z):
                decor.picture_frame(build, rng, width, height, f"picture {k}")


def _at_windows(of: Furnisher) -> None:
    """Optional curtains, a plant on the sill, a radiator if nothing stands there."""
    build, rng = of.build, of.rng
    for wall, window in of.windows.items():
        wide = max(0.6, round(0.7 * window.width / 0.06) * 0.06)
        size = (wide, 0.12, 0.7)
        under = of.arrangement.stand(rng, size, [wall], 0.0, near=window.along, off=0.25)
        if under is not None:
            with of.at(under):
                fittings.radiator(build, wide, f"radiator {wall}")
        if window.width > 0.9:
            with of.at(Spot(wall, window.along + rng.uniform(-0.4, 0.4), -0.02), window.sill):
                decor.plant(build, rng, 0.36, f"sill plant {wall}")
        if of.kind in ("bathroom", "kitchen"):
            continue
        _curtains(of, wall)


def _curtains(of: Furnisher, wall: int) -> None:
    """Curtains on both sides of a window, down to the floor if nothing stands there."""
    build, rng, window = of.build, of.rng, of.windows[wall]
    cloth = decor.curtain_cloth(rng)
    top = window.sill + window.height + 0.15
    for k, side in enumerate((-1, 1)):
        x = window.along + side * (window.width / 2 + 0.12)
        if not of.arrangement.is_clear_of_doors(wall, x - 0.24, x + 0.24, 0.17):
            continue
        is_free = of.arrangement.is_floor_free(wall, x - 0.24, x + 0.24, 0.17)
        long = top - 0.05 if is_free else window.height + 0.2
        with of.at(Spot(wall, x, 0.0), top):
            decor.curtain(build, rng, 0.45, long, cloth, f"curtain {wall}.{k}")
    with of.at(Spot(wall, window.along, 0.0), top), build.object(f"curtain rod {wall}"):
        half = window.width / 2 + 0.42
        build.box((-half, -0.11, 0), (half, -0.09, 0.02), build.plain((70, 58, 48)))


def _switches(of: Furnisher) -> None:
    """A switch beside each door."""
    for k, door in enumerate(of.doors):
        beside = door.opening.along + (door.opening.width / 2 + 0.2) * (-door.hinge or 1)
        spot = of.arrangement.hang(of.rng, (0.08, 0.08), 1.1, [door.wall], beside, 0.4)
        if spot is not None:
            with of.at(spot, 1.1):
                decor.light_switch(of.build, f"light switch {k}")
