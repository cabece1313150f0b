"""Furnish a home: the recipes of its rooms, then whatever suits them in the places that are left."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.datasets.homes.catalogue import Catalogue
from su3d_bench.datasets.homes.groups import FREE, RELATIVE, Thing
from su3d_bench.datasets.homes.layout import LAYOUTS, Zone, draw_layout
from su3d_bench.datasets.homes.model_format import Strict
from su3d_bench.datasets.homes.plan import GAP_M, HomePlan, first
from su3d_bench.datasets.homes.shell import add_openings, add_shell
from su3d_bench.datasets.procedural.items import Item, Light, Placed, Spot
from su3d_bench.datasets.procedural.shapes import rotation

N_OBJECTS = (95, 145)  # of a home without its shell: the fewest and the most
PER_M2 = (2.4, 3.6)  # objects: small homes hold the fewest, large ones would look empty with them
FEWEST = 90  # a home with space for fewer, or with a blocked way, is drawn again
SMALLEST_M = 0.06  # longest side of what the filler adds: smaller things have too few pixels to be annotated
MAX_FAILURES = 160  # of the filler before a home counts as full
HIGH_M = 1.5  # tops above hold what is put on shelves
RARER = 0.45  # factor on the weight of a class for each object of it that is there
MODES = {"surface": 0.36, "shelf": 0.27, "floor": 0.12, "hung": 0.08, "wall": 0.05, "corner": 0.04, "seat": 0.05,
         "inside": 0.02, "ceiling": 0.01}  # fmt: skip


class Kind(Strict):
    """A kind of zone: ``suits``: the kinds of rooms of the catalogue; floor coverings; steps: names of things."""

    suits: tuple[str, ...]
    covers: tuple[str, ...]
    steps: tuple[str, ...]


class Repeats(Strict):
    """How objects of a class are repeated: as a row, stack, pair or scatter of ``n``, with a ``chance``."""

    how: str
    n: tuple[int, int]
    chance: float
    same: bool = True


_TABLE = parse_toml(file_text(Path(__file__).with_name("recipes.toml")))
KINDS: Mapping[str, Kind] = {name: Kind.model_validate(row) for name, row in _TABLE["kinds"].items()}
THINGS: Mapping[str, Thing] = {name: Thing.model_validate(row) for name, row in _TABLE["things"].items()}
REPEATS: Mapping[str, tuple[Repeats, ...]] = {
    name: tuple(Repeats.model_validate(row) for row in rows) for name, rows in _TABLE["repeats"].items()
}


def furnish(
    rng: np.random.Generator, catalogue: Catalogue, training: bool = False, layout: str | None = None
) -> HomePlan:
    """A furnished home, of the named layout or any."""
    muted, is_evening = bool(rng.random() < 0.5), bool(rng.random() < 0.3)
    layout = layout or str(rng.choice(list(LAYOUTS)))  # before homes are drawn again, so that all are equally frequent
    while True:
        home = _Furnisher(HomePlan(rng, draw_layout(rng, layout), muted, is_evening), catalogue, training)
        if home.is_begun() and home.finished().n_objects >= FEWEST and home.plan.is_passable():
            return home.plan


class _Furnisher:
    def __init__(self, plan: HomePlan, catalogue: Catalogue, training: bool) -> None:
        self.plan, self.catalogue, self.training = plan, catalogue, training
        self.rng = plan.rng
        self.n_of: dict[str, int] = {}

    def is_begun(self) -> bool:
        """Builds the bare home; whether it has its doors and a window in each room."""
        rooms = self.plan.layout.rooms
        add_shell(self.plan, [str(self.rng.choice(KINDS[room.kinds[0]].covers)) for room in rooms])
        return add_openings(self.plan, self.new)

    def finished(self) -> HomePlan:
        plan = self.plan
        area = sum((x1 - x0) * (y1 - y0) for room in plan.layout.rooms for x0, x1, y0, y1 in room.tiles()[0])
        target = round(float(np.clip(area * plan.uniform(*PER_M2), *N_OBJECTS)))
        for zone in plan.layout.zones:
            self.do("ceiling_lamp", zone)
        for zone in plan.layout.zones:
            for step in KINDS[zone.kind].steps:
                self.do(step, zone)
        for zone in plan.layout.zones:
            self.do("plug", zone)
        self.fill(target)
        self.finish_lights()
        return plan

    def new(self, class_name: str, tall: tuple[float, float] = (0.0, 5.0), model: str = "") -> Item | None:
        """A new instance of a class (of a model), with a height in the range; ``None`` if there is no such model."""
        models = [one for one in self.catalogue.models(class_name, self.training) if model in ("", one.name)]
        for k in self.rng.permutation(len(models)):
            item = models[int(k)].build(self.rng, self.plan.muted)
            if tall[0] <= item.size[2] <= tall[1]:
                return item
        return None

    def do(self, name: str, zone: Zone, anchor: Placed | None = None) -> Placed | None:
        """Place a thing and what belongs to it; return its last object, ``None`` if nothing fits."""
        thing = THINGS[name]
        if self.rng.random() >= thing.chance:
            return None
        if thing.any:
            return first(self.do(thing.any[int(k)], zone, anchor) for k in self.rng.permutation(len(thing.any)))
        n = 1 if thing.at == "run" else int(self.rng.integers(thing.n[0], thing.n[1] + 1))
        item, last = None, None
        for _ in range(n):
            if item is None or not thing.same:
                wanted = str(self.rng.choice(thing.put))
                item = anchor.item if anchor and wanted == "=" else self.new(wanted, thing.tall)
            if item is None:
                continue
            last = self._place(item, thing, zone, anchor) or last
        return last

    def _place(self, item: Item, thing: Thing, zone: Zone, anchor: Placed | None) -> Placed | None:
        plan, before = self.plan, len(self.plan.placed)
        if thing.at in FREE:
            placed = FREE[thing.at](plan, item, thing, zone)
        else:
            assert anchor is not None, f"{thing.at} needs an anchor"
            placed = RELATIVE[thing.at](plan, item, thing, zone, anchor)
        if placed is None:
            return None
        if any(self.do(need, zone, placed) is None for need in thing.needs):
            plan.back_to(before)
            return None
        if thing.repeat:
            self._repeat(item, placed)
        for name in thing.then:
            self.do(name, zone, placed)
        return placed

    def fill(self, target: int) -> None:
        """Adds what suits the places that are left, rarely what is there already, up to ``target`` objects."""
        plan = self.plan
        modes, weights = list(MODES), np.array(list(MODES.values()))
        self.n_of = dict.fromkeys(self.catalogue.classes, 0)
        for placed in plan.placed:
            self.n_of[placed.item.class_name] += 1
        failures = 0
        while plan.n_objects < target and failures < MAX_FAILURES:
            before = len(plan.placed)
            zone = plan.layout.zones[int(self.rng.integers(len(plan.layout.zones)))]
            self._fill_one(modes[int(self.rng.choice(len(modes), p=weights / weights.sum()))], zone, target - before)
            failures += len(plan.placed) == before
            for placed in plan.placed[before:]:
                self.n_of[placed.item.class_name] += 1

    def _fill_one(self, mode: str, zone: Zone, most: int) -> None:
        places = self._open_spots(mode, zone) if mode in ("surface", "shelf", "seat", "inside") else []
        item = self._suitable(mode, zone) if places or mode in FREE else None
        if item is None:
            return
        name = item.class_name
        if mode in FREE:
            height = self.catalogue.classes[name].row.height
            placed = FREE[mode](self.plan, item, Thing(z=height, air=0.02), zone)
            if placed and mode == "floor":
                self._repeat(item, placed, most)
            return
        areas = np.array([(s.x1 - s.x0) * (s.y1 - s.y0) for _, s in places]) ** 0.5
        for k in self.rng.choice(len(places), min(len(places), 4), replace=False, p=areas / areas.sum()):
            holder, spot = places[int(k)]
            placed = self.plan.on_spot(item, holder, spot, "any", 25.0 if mode == "seat" else 6.0)
            if placed:
                self._repeat(item, placed, most)
                return

    def _open_spots(self, mode: str, zone: Zone) -> list[tuple[Placed, Spot]]:
        roles = {"surface": ("top",), "shelf": ("board", "top"), "seat": ("seat", "head"), "inside": ("inside",)}[mode]
        places = []
        for placed in self.plan.placed[self.plan.n_structure :]:
            if not zone.contains(placed.position[:2]) or placed.item.size[:2].max() < 0.2:
                continue
            for spot in placed.item.spots:
                is_high = placed.position[2] + spot.z > HIGH_M or placed.item.class_name == "shelf"
                if spot.role in roles and (spot.role != "top" or is_high == (mode == "shelf")):
                    places.append((placed, spot))
        return places

    def _suitable(self, mode: str, zone: Zone) -> Item | None:
        suits = KINDS[zone.kind].suits
        rows = [(name, known.row) for name, known in self.catalogue.classes.items() if mode in known.row.where]
        rows = [(name, row) for name, row in rows if not row.rooms or set(row.rooms) & set(suits)]
        if not rows:
            return None
        rarer = RARER**2 if mode in FREE else RARER  # a second piece of furniture is rarer than a second cup
        weights = np.array([row.often * rarer ** self.n_of[name] for name, row in rows])
        item = self.new(rows[int(self.rng.choice(len(rows), p=weights / weights.sum()))][0])
        return item if item is not None and item.size.max() >= SMALLEST_M else None

    def _repeat(self, item: Item, begun_by: Placed, most: int = 6) -> None:
        """More objects of the class beside, on or around the first one."""
        for row in REPEATS.get(item.class_name, ()):
            tall = item.size[2] / item.size[0]
            if (
                self.rng.random() >= row.chance
                or (row.how == "stack" and tall > 1)
                or (row.how == "row" and tall < 0.3)
            ):
                continue
            last = begun_by
            for _ in range(min(most, int(self.rng.integers(row.n[0], row.n[1] + 1))) - 1):
                other = item if row.same else self.new(item.class_name, model=item.model) or item
                placed = self._next(row.how, other, last)
                if placed is None:
                    return
                last = placed
            return

    def _next(self, how: str, item: Item, last: Placed) -> Placed | None:
        plan = self.plan
        if how == "stack":
            return plan.on_top(item, last, 10.0)
        jitter = plan.uniform(-4, 4) if how == "pair" else 0.0
        x = (last.item.size[0] + item.size[0]) / 2 + (0.02 if how == "pair" else 0.003)
        if last.id not in plan.parent:
            if how == "scatter":
                x, y = self.rng.uniform(-0.6, 0.6, 2)
                return plan.by(item, last, float(x), float(y), plan.uniform(-180, 180))
            return plan.by(item, last, x, 0.0, jitter)
        holder = plan.placed[plan.parent[last.id][0] - 1]
        local = rotation("z", -holder.yaw) @ (last.position - holder.position)
        spot = next(
            (
                s
                for s in holder.item.spots
                if abs(s.z + GAP_M - local[2]) < GAP_M and s.x0 <= local[0] <= s.x1 and s.y0 <= local[1] <= s.y1
            ),
            None,
        )
        if spot is None:
            return None
        if how == "scatter":
            return plan.on_spot(item, holder, spot, "any", 180.0)
        turn = last.yaw - holder.yaw
        for side in (1, -1):
            step = np.array([np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn)), 0.0]) * (side * (x + 0.004))
            at, half = local + step, item.size[:2] / 2
            if spot.x0 <= at[0] - half[0] and at[0] + half[0] <= spot.x1 and spot.y0 <= at[1] <= spot.y1:
                world, relation = holder.to_world(at), plan.parent[last.id][1]
                placed = plan.put(item, world[:2], last.yaw, float(last.position[2]), "object", holder, relation)
                if placed:
                    return placed
        return None

    def finish_lights(self) -> None:
        """The light of the lamps: all of them in the evening, some by day; each room has one at least."""
        plan = self.plan
        for placed in plan.placed:
            if placed.item.lights and (plan.is_evening or self.rng.random() < 0.35):
                for light in placed.item.lights:
                    x, y, z = placed.to_world(np.array(light.position)).tolist()
                    plan.lights.append(replace(light, position=(x, y, z)))
        for room in plan.layout.rooms:
            if not any(room.contains(np.array(light.position[:2])) for light in plan.lights):
                x0, x1, y0, y1 = room.tiles()[0][0]
                z = float(room.ceiling(np.array([(x0 + x1) / 2, (y0 + y1) / 2]))) - 0.2
                plan.lights.append(Light(((x0 + x1) / 2, (y0 + y1) / 2, z), (0.75, 0.72, 0.66), 0.3))
