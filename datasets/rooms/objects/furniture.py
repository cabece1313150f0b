"""Builders of furniture: it stands on the floor and carries other objects."""

from __future__ import annotations

from su3d_bench.datasets.procedural.materials import mix, shade, tone
from su3d_bench.datasets.procedural.shapes import Shape, block, both, box, corners, cylinder, lathe, soft_block, tube
from su3d_bench.datasets.rooms.objects.items import Assembly


def _legs(width: float, depth: float, height: float, thick: float, inset: float = 0.02) -> list[Shape]:
    x, y = width / 2 - inset - thick / 2, depth / 2 - inset - thick / 2
    return [block(thick, thick, height, *foot) for foot in corners(x, y)]


def _knob(x: float, y: float, z: float) -> Shape:
    return soft_block(0.034, 0.03, 0.034, x, y - 0.014, z - 0.017, 0.014)


def _handle(x: float, y: float, z0: float, z1: float) -> Shape:
    return tube([(x, y, z0), (x, y - 0.03, z0 + 0.001), (x, y - 0.03, z1 - 0.001), (x, y, z1)], 0.007, 6)


def chair(build: Assembly) -> None:
    width, depth, seat = build.size(0.42, 0.5), build.size(0.42, 0.5), build.rng.uniform(0.43, 0.48)
    back = build.rng.uniform(0.4, 0.52) * build.scale**0.5
    kind = int(build.rng.integers(0, 3)) if build.material == "wooden" else 3
    frame = build.main(axis=2)
    if kind == 3:
        _shell_chair(build, width, depth, seat, back)
        return
    build.add(frame, *_legs(width, depth, seat - 0.04, 0.042, 0.0))
    build.add(build.main(axis=1), soft_block(width, depth, 0.045, 0, 0, seat - 0.04, 0.012))
    if build.chance(0.4):
        cover = build.of("fabric", build.other("red", "blue", "beige", "green"))
        build.add(cover, soft_block(width * 0.92, depth * 0.9, 0.045, 0, -0.01, seat + 0.005, 0.02))
    y = depth / 2 - 0.021
    build.add(frame, *[block(0.042, 0.042, back + 0.0, x, y, seat) for x in both(width / 2 - 0.021)])
    build.add(frame, block(width, 0.036, 0.075, 0, y, seat + back - 0.07))
    if kind == 0:
        n = int(build.rng.integers(3, 6))
        xs = [(i + 1) / (n + 1) * width - width / 2 for i in range(n)]
        build.add(frame, *[block(0.026, 0.02, back - 0.08, x, y, seat + 0.01) for x in xs])
    elif kind == 1:
        build.add(frame, *[block(width - 0.08, 0.022, 0.06, 0, y, seat + back * share) for share in (0.22, 0.5)])
    else:
        build.add(frame, soft_block(width - 0.07, 0.026, back * 0.75, 0, y, seat + 0.06, 0.01))


def _shell_chair(build: Assembly, width: float, depth: float, seat: float, back: float) -> None:
    shell = build.main()
    build.add(shell, soft_block(width, depth, 0.05, 0, 0, seat - 0.03, 0.024))
    rest = soft_block(width * 0.96, 0.04, back, 0, 0, 0, 0.019).turned("x", -9).moved(0, depth / 2 + 0.01, seat)
    build.add(shell, rest)
    steel = build.of("chrome")
    if build.chance(0.5):  # office chair: column and five-armed foot
        build.add(steel, cylinder(0.03, seat - 0.11, z=0.08))
        for i in range(5):
            build.add(build.of("plastic", "black"), box(0.0, 0.27, -0.022, 0.022, 0.05, 0.085).turned("z", 72 * i + 18))
            wheel = soft_block(0.05, 0.035, 0.05, 0.25, 0, 0, 0.017).turned("z", 72 * i + 18)
            build.add(build.of("plastic", "black"), wheel)
        if build.chance(0.5):
            for side in (-1, 1):
                x = side * (width / 2 + 0.01)
                bar = [(x, 0.08, seat), (x + side * 0.03, 0.08, seat + 0.2), (x + side * 0.03, -0.12, seat + 0.2)]
                build.add(build.of("plastic", "black"), tube(bar, 0.016))
        return
    for sx in (-1, 1):
        for sy in (-1, 1):
            top = (sx * width * 0.36, sy * depth * 0.36, seat - 0.02)
            build.add(steel, tube([(sx * width * 0.48, sy * depth * 0.5, 0.0), top], 0.014))


def stool(build: Assembly) -> None:
    radius, height = build.size(0.16, 0.2), build.rng.uniform(0.42, 0.62) * build.scale
    seat = lathe([(0, 0), (radius * 0.96, 0), (radius, 0.02), (radius, 0.05), (0, 0.055)])
    build.add(build.main(), seat.moved(z=height - 0.05))
    legs = build.of("chrome") if build.material == "metal" else build.main(axis=2)
    reach = radius * 0.95
    for x, y in corners(reach, reach):
        build.add(legs, tube([(x, y, 0), (x * 0.62, y * 0.62, height - 0.048)], 0.017))
    ring = 0.85 * reach
    for sign in (-1, 1):
        build.add(legs, tube([(-ring, sign * ring, 0.2), (ring, sign * ring, 0.2)], 0.01, 6))


def bench(build: Assembly) -> None:
    width, depth, height = build.size(1.0, 1.3), build.size(0.34, 0.4), build.rng.uniform(0.42, 0.47)
    plank = (depth - 0.03) / 3
    for i in (-1, 0, 1):
        build.add(build.main(axis=0), soft_block(width, plank, 0.04, 0, i * (plank + 0.012), height - 0.04, 0.008))
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.12)
        build.add(build.main(axis=2), block(0.06, depth * 0.9, 0.06, x, 0, height - 0.1))
        build.add(build.main(axis=2), *[block(0.06, 0.06, height - 0.1, x, y) for y in both(depth * 0.45 - 0.03)])
    build.add(build.main(axis=0), block(width - 0.25, 0.04, 0.05, 0, 0, 0.14))
    build.spot(both(width / 2), both(depth / 2), height, role="seat")


def beanbag(build: Assembly) -> None:
    r, h = build.size(0.38, 0.46), build.size(0.55, 0.68)
    profile = [(0, 0), (r * 0.8, 0.0), (r * 0.97, 0.07), (r, 0.16), (r * 0.9, h * 0.5), (r * 0.62, h * 0.78),
               (r * 0.3, h * 0.95), (0.05, h), (0, h)]  # fmt: skip
    body = lathe(profile, 24)
    build.add("plain fabric", body)
    build.add(build.of("plain fabric", shade(build.rgb, 0.6)), cylinder(0.03, 0.05, z=h - 0.005))


def sofa(build: Assembly) -> None:
    width, depth = build.size(1.55, 2.0), build.rng.uniform(0.82, 0.92)
    arm, seat, back = build.rng.uniform(0.13, 0.2), 0.42, build.rng.uniform(0.76, 0.86)
    cover = build.of("leather") if build.material == "leather" else build.of("plain fabric")
    build.add(cover, soft_block(width - 0.02, depth - 0.02, 0.22, 0, 0, 0.08, 0.03))
    arm_top = build.rng.uniform(0.56, 0.64)
    build.add(cover, *[soft_block(arm, depth, arm_top - 0.07, x, 0, 0.07, 0.06) for x in both((width - arm) / 2)])
    build.add(cover, soft_block(width - 2 * arm, 0.2, back - 0.1, 0, depth / 2 - 0.1, 0.1, 0.06))
    n = 3 if width > 1.75 else 2
    inner = (width - 2 * arm) / n
    soft = cover if build.chance(0.6) else build.of("plain fabric", shade(build.rgb, 0.75))
    for i in range(n):
        x = (i - (n - 1) / 2) * inner
        build.add(soft, soft_block(inner - 0.008, depth - 0.24, 0.14, x, -0.1, seat - 0.13, 0.045))
        rest = soft_block(inner - 0.01, 0.14, back - seat - 0.04, 0, 0, 0, 0.05).turned("x", -8)
        build.add(soft, rest.moved(x, depth / 2 - 0.27, seat + 0.01))
    build.add(build.of("wooden", "brown", 2), *_legs(width, depth, 0.085, 0.05, 0.05))
    build.spot((-width / 2 + arm, width / 2 - arm), (-depth / 2 + 0.06, depth / 2 - 0.34), seat + 0.012, role="seat")


def bed(build: Assembly) -> None:
    width, length = build.size(1.2, 1.6), build.rng.uniform(1.95, 2.05)
    width = max(0.95, width)
    head = build.rng.uniform(0.85, 1.05)
    build.add(build.main(axis=0), soft_block(width, 0.06, head, 0, length / 2 - 0.03, 0, 0.015))
    build.add(build.main(axis=0), soft_block(width, 0.04, 0.42, 0, -length / 2 + 0.02, 0, 0.012))
    build.add(build.main(axis=1), block(width, length - 0.1, 0.18, 0, -0.01, 0.16))
    build.add(build.main(axis=2), *_legs(width, length, 0.16, 0.06, 0.01))
    sheet_rgb = mix(tone("white"), build.other("blue", "beige", "grey", "pink"), 0.15)
    top = 0.53
    linen = build.of("plain fabric", sheet_rgb)
    build.add(linen, soft_block(width - 0.05, length - 0.13, 0.2, 0, -0.01, top - 0.2, 0.05))
    duvet_colour = build.other("blue", "white", "grey", "beige", "green", "purple", "red")
    duvet = build.of("large fabric", duvet_colour)
    cover = soft_block(width + 0.05, length * 0.62, 0.3, 0, -length * 0.19 + 0.045, top - 0.22, 0.07)
    build.add(duvet, cover)
    fold = soft_block(width + 0.02, 0.18, 0.07, 0, length * 0.12 + 0.05, top + 0.04, 0.03)
    build.add(build.of("plain fabric", sheet_rgb), fold)
    build.spot(both(width / 2 - 0.06), (length / 2 - 0.56, length / 2 - 0.1), top + 0.003, role="head")
    build.spot(both(width / 2 - 0.08), (-length / 2 + 0.12, length * 0.02), top + 0.082, role="seat")


def table(build: Assembly) -> None:
    if build.chance(0.3):
        _round_table(build)
        return
    width, depth, height = build.size(1.15, 1.5), build.size(0.75, 0.9), build.rng.uniform(0.72, 0.76)
    build.add(build.main(axis=0), soft_block(width, depth, 0.04, 0, 0, height - 0.04, 0.01))
    build.add(build.main(axis=2), *_legs(width, depth, height - 0.04, 0.07, 0.03))
    for sy in (-1, 1):
        build.add(build.main(axis=0), block(width - 0.22, 0.025, 0.08, 0, sy * (depth / 2 - 0.065), height - 0.12))
    build.spot(both(width / 2 - 0.03), both(depth / 2 - 0.03), height)


def _round_table(build: Assembly) -> None:
    radius, height = build.size(0.48, 0.6), build.rng.uniform(0.71, 0.75)
    top = lathe([(0, 0), (radius - 0.02, 0), (radius, 0.012), (radius, 0.03), (radius - 0.006, 0.036), (0, 0.036)], 36)
    build.add(build.main(), top.moved(z=height - 0.036))
    build.add(build.main(axis=2), cylinder(0.05, height - 0.07, z=0.035))
    build.add(build.main(), lathe([(0, 0), (0.3, 0), (0.3, 0.015), (0.06, 0.06), (0, 0.06)]))
    side = radius * 0.68
    build.spot(both(side), both(side), height)


def coffee_table(build: Assembly) -> None:
    width, depth, height = build.size(0.85, 1.1), build.size(0.5, 0.6), build.rng.uniform(0.38, 0.45)
    build.add(build.main(axis=0), soft_block(width, depth, 0.045, 0, 0, height - 0.045, 0.012))
    build.add(build.main(axis=2), *_legs(width, depth, height - 0.045, 0.055, 0.04))
    build.add(build.main(axis=0), block(width - 0.16, depth - 0.16, 0.02, 0, 0, 0.12))
    build.spot(both(width / 2 - 0.03), both(depth / 2 - 0.03), height)


def side_table(build: Assembly) -> None:
    radius, height = build.size(0.22, 0.27), build.rng.uniform(0.48, 0.58)
    build.add(build.main(), lathe([(0, 0), (radius, 0), (radius, 0.028), (0, 0.028)]).moved(z=height - 0.028))
    for i in range(3):
        foot = tube([(radius * 0.95, 0, 0), (radius * 0.45, 0, height - 0.027)], 0.018).turned("z", 120 * i + 90)
        build.add(build.main(axis=2), foot)
    side = radius * 0.66
    build.spot(both(side), both(side), height)


def desk(build: Assembly) -> None:
    width, depth, height = build.size(1.25, 1.55), build.rng.uniform(0.65, 0.75), build.rng.uniform(0.72, 0.76)
    build.add(build.main(axis=0), soft_block(width, depth, 0.035, 0, 0, height - 0.035, 0.008))
    body = build.main(axis=0)
    side = 1 if build.chance(0.5) else -1
    x = side * (width / 2 - 0.23)
    build.add(body, block(0.42, depth - 0.06, height - 0.1, x, 0.01, 0.06))
    front = -depth / 2 + 0.04
    pull = build.of("chrome")
    drawer = (height - 0.12) / 3
    for i in range(3):
        z = 0.075 + i * drawer
        build.add(build.main(axis=0), block(0.395, 0.018, drawer - 0.02, x, front - 0.009, z))
        middle = z + drawer * 0.5
        build.add(pull, box(x - 0.07, x + 0.07, front - 0.04, front - 0.018, middle, middle + 0.014))
    legs = [block(0.05, 0.05, height - 0.036, -side * (width / 2 - 0.045), y) for y in both(depth / 2 - 0.045)]
    build.add(build.main(axis=2), *legs)
    build.add(build.main(axis=0), block(width - 0.55, 0.018, 0.3, -side * 0.2, depth / 2 - 0.06, height - 0.36))
    build.spot(both(width / 2 - 0.02), both(depth / 2 - 0.02), height)


def _fronts(
    build: Assembly, width: float, depth: float, z0: float, z1: float, columns: int, rows: int, knob: bool
) -> None:
    """Doors or drawers with a gap around each, on the front of a box."""
    cell, tall = (width - 0.012) / columns, (z1 - z0) / rows
    for column in range(columns):
        for row in range(rows):
            x, z = (column - (columns - 1) / 2) * cell, z0 + row * tall
            front = block(cell - 0.012, 0.02, tall - 0.014, x, -depth / 2 - 0.01, z + 0.007)
            build.add(build.main(axis=0 if rows > 1 else 2), front)
            y = -depth / 2 - 0.02
            if knob:
                side = x if rows > 1 else x + (1 if column < columns / 2 else -1) * (cell / 2 - 0.05)
                build.add("chrome", _knob(side, y, z + tall * (0.5 if rows > 1 else 0.6)))
            else:
                side = x + (1 if column < columns / 2 else -1) * (cell / 2 - 0.045)
                build.add("chrome", _handle(side, y, z + tall * 0.4, z + tall * 0.66))


def nightstand(build: Assembly) -> None:
    width, depth, height = build.size(0.42, 0.5), build.rng.uniform(0.36, 0.42), build.rng.uniform(0.46, 0.56)
    build.add(build.main(axis=0), block(width, depth, height - 0.12, 0, 0, 0.12))
    build.add(build.main(axis=2), *_legs(width, depth, 0.12, 0.045, 0.0))
    build.add(build.main(axis=0), soft_block(width + 0.03, depth + 0.03, 0.025, 0, 0, height, 0.008))
    _fronts(build, width, depth, 0.13, height - 0.01, 1, 2, True)
    build.spot(both(width / 2), both(depth / 2), height + 0.025)


def cabinet(build: Assembly) -> None:
    width, depth, height = build.size(0.85, 1.15), build.rng.uniform(0.38, 0.44), build.rng.uniform(0.82, 1.02)
    build.add(build.main(axis=0), block(width, depth, height - 0.1, 0, 0, 0.08))
    build.add(build.main(axis=2), *_legs(width, depth, 0.08, 0.05, 0.02))
    build.add(build.main(axis=0), soft_block(width + 0.04, depth + 0.03, 0.03, 0, -0.005, height - 0.02, 0.008))
    split = height * 0.68
    _fronts(build, width, depth, 0.09, split, 2, 1, True)
    _fronts(build, width, depth, split, height - 0.025, 2, 1, True)
    build.spot(both(width / 2), both(depth / 2), height + 0.01)


def base_cabinet(build: Assembly) -> None:
    width, depth, height = build.rng.uniform(0.6, 0.85), 0.58, 0.86
    build.add(build.main(axis=2), block(width, depth, height - 0.1, 0, 0, 0.1))
    build.add(build.of("paint", "black"), block(width - 0.01, depth - 0.07, 0.1, 0, 0.03, 0))
    _fronts(build, width, depth, 0.11, 0.66, 2, 1, False)
    _fronts(build, width, depth, 0.66, height - 0.005, 1, 1, True)
    build.spot(both(width / 2), both(depth / 2), height, role="base")


def wall_cabinet(build: Assembly) -> None:
    width, depth, height = build.size(0.6, 0.85), 0.33, build.rng.uniform(0.55, 0.68)
    build.add(build.main(axis=2), block(width, depth, height))
    _fronts(build, width, depth, 0.0, height, 2, 1, False)


def wardrobe(build: Assembly) -> None:
    width, depth, height = build.size(1.05, 1.35), build.rng.uniform(0.54, 0.6), build.rng.uniform(1.92, 2.08)
    build.add(build.main(axis=2), block(width, depth, height - 0.06, 0, 0, 0.06))
    build.add(build.of("paint", "black"), block(width - 0.06, depth - 0.05, 0.06, 0, 0.02, 0))
    build.add(build.main(axis=0), block(width + 0.05, depth + 0.05, 0.05, 0, -0.01, height))
    _fronts(build, width, depth, 0.4, height - 0.01, 3 if width > 1.25 else 2, 1, False)
    _fronts(build, width, depth, 0.08, 0.4, 2, 1, True)


def shelf(build: Assembly) -> None:
    width, depth, height = build.size(0.8, 1.0), build.rng.uniform(0.3, 0.36), build.rng.uniform(1.5, 1.85)
    n = 5 if height > 1.65 else 4
    thick = 0.028
    if build.material == "metal":
        build.add(build.main(), *_legs(width, depth, height, 0.03, 0.0))
    else:
        build.add(build.main(axis=2), *[block(thick, depth, height, x) for x in both(width / 2 - thick / 2)])
        build.add(build.main(axis=2), block(width - 2 * thick, 0.01, height - 0.06, 0, depth / 2 - 0.006, 0.05))
    step = (height - 0.06 - thick) / (n - 1)
    for i in range(n):
        z = 0.06 + i * step
        build.add(build.main(axis=0), block(width - 2 * thick, depth - 0.012, thick, 0, -0.006, z))
        clearance = step - thick - 0.015 if i < n - 1 else 0.5
        role = "board" if i < n - 1 else "top"
        build.spot(both(width / 2 - 0.045), (-depth / 2 + 0.01, depth / 2 - 0.02), z + thick, clearance, role)


def wall_shelf(build: Assembly) -> None:
    width, depth = build.size(0.75, 1.0), build.rng.uniform(0.22, 0.27)
    build.add(build.main(axis=0), block(width, depth, 0.032, 0, 0, 0.12))
    for sx in (-1, 1):
        x = sx * (width / 2 - 0.12)
        build.add(build.main(axis=1), block(0.024, depth - 0.02, 0.022, x, 0.005, 0.098))
        build.add(build.main(axis=2), block(0.024, 0.022, 0.12, x, depth / 2 - 0.011, 0.0))
    build.spot(both(width / 2 - 0.01), (-depth / 2 + 0.005, depth / 2 - 0.01), 0.152, 0.45)


def tv_stand(build: Assembly) -> None:
    width, depth, height = build.size(1.25, 1.55), build.rng.uniform(0.38, 0.44), build.rng.uniform(0.44, 0.52)
    for z in (0.06, height - 0.035):
        build.add(build.main(axis=0), block(width, depth, 0.035, 0, 0, z))
    walls = -width / 2 + 0.015, -width / 6, width / 6, width / 2 - 0.015
    build.add(build.main(axis=2), *[block(0.03, depth - 0.004, height - 0.13, x, 0, 0.095) for x in walls])
    build.add(build.main(axis=0), block(width - 0.06, 0.01, height - 0.13, 0, depth / 2 - 0.008, 0.095))
    for sx in (-1, 1):
        x = sx * width / 3
        build.add(build.main(axis=0), block(width / 3 - 0.04, 0.02, height - 0.145, x, -depth / 2 + 0.012, 0.1))
        build.add("chrome", _knob(x, -depth / 2, height / 2 + 0.03))
    build.add(build.main(axis=2), *_legs(width, depth, 0.06, 0.05, 0.05))
    build.spot(both(width / 2 - 0.02), both(depth / 2 - 0.01), height)
    build.spot(both(width / 6 - 0.03), (-depth / 2 + 0.02, depth / 2 - 0.04), 0.095, height - 0.15, "board")


def plant_stand(build: Assembly) -> None:
    radius, height = build.size(0.14, 0.17), build.size(0.45, 0.62)
    frame = build.main(axis=2)
    build.add(frame, lathe([(0, 0), (radius, 0), (radius, 0.022), (0, 0.022)]).moved(z=height - 0.022))
    for i in range(3):
        leg = tube([(radius * 1.15, 0, 0), (radius * 0.8, 0, height * 0.5), (radius * 0.75, 0, height - 0.02)], 0.012)
        build.add(frame, leg.turned("z", 120 * i + 30))
    build.add(frame, lathe([(0, 0), (radius * 0.78, 0), (radius * 0.78, 0.014), (0, 0.014)]).moved(z=height * 0.45))
    side = radius * 0.7
    build.spot(both(side), both(side), height, 1.0)
