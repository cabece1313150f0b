// The content of a map as reports/page/maps.py packs it, and what of it stands between an eye outside and the inside.

// The cells of a tree, level after level: a byte a cell whose bits are the eighths of it that hold anything.
function cellsOf(data, at, depth) {
  let x = [0], y = [0], z = [0];
  for (let level = 0; level < depth; level++) {
    const next = [[], [], []];
    for (let cell = 0; cell < x.length; cell++, at++) {
      for (let eighth = 0; eighth < 8; eighth++) {
        if (!(data[at] & (1 << eighth))) continue;
        next[0].push(2 * x[cell] + (eighth & 1));
        next[1].push(2 * y[cell] + ((eighth >> 1) & 1));
        next[2].push(2 * z[cell] + (eighth >> 2));
      }
    }
    [x, y, z] = next;
  }
  return { x, y, z, at };
}

async function unpackMap(text) {
  const bytes = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
  const data = new Uint8Array(await new Response(stream).arrayBuffer());
  const length = new DataView(data.buffer).getUint32(0, true);
  const about = JSON.parse(new TextDecoder().decode(data.subarray(4, 4 + length)));
  const { n } = about, cells = cellsOf(data, 4 + length, about.depth);
  const positions = new Uint16Array(3 * n), most = [0, 0, 0];
  let { at } = cells;
  [cells.x, cells.y, cells.z].forEach((along, axis) => {
    for (let k = 0; k < n; k++) {
      positions[3 * k + axis] = along[k];
      if (along[k] > most[axis]) most[axis] = along[k];
    }
  });
  const planes = {};
  for (const plane of about.planes) {
    const { bytes: size, width } = plane;
    const values = size === 2 ? new Uint16Array(n * width) : new Uint8Array(n * width);
    for (let column = 0; column < width; column++) {
      for (let k = 0; k < n; k++) values[k * width + column] = data[at + k] + (size === 2 ? 256 * data[at + n + k] : 0);
      at += n * size;
    }
    planes[plane.name] = values;
  }
  const { owner, colour, truth, class: classOfPoint } = planes;
  const map = { ...about, positions, owner, colour, truth, classOfPoint,
    low: about.origin, high: about.origin.map((v, i) => v + most[i] * about.step) };
  return { ...map, outward: outwardOf(map) };
}

const CELL_M = 0.2, MAX_LAYERS = 30, WALL_SHARE = 0.6, LAYER_SHARE = 0.3, LAYER_M = 0.15;
const SURFACES = ['wall', 'ceiling', 'floor'];

// Of each point three bytes: where the outside is of the wall, ceiling or floor that it is part of, else zeros.
// A wall is a column of the map that is filled over most of its height, whatever stands there; so is what hangs on it.
// Where the truth or the map calls a point wall, ceiling or floor, that goes before.
function outwardOf(map) {
  const outward = new Int8Array(3 * map.n);
  if (!map.n) return outward;
  const at = (k, axis) => map.positions[3 * k + axis] * map.step;
  const named = surfacesNamed(map), cell = Math.max(CELL_M, 2.5 * map.spacing);
  const [lowZ, highZ] = spanOf(map, 2), layer = Math.max(cell, (highZ - lowZ) / MAX_LAYERS);
  const wide = Math.ceil((map.high[0] - map.low[0]) / cell) + 1;
  const columnOf = new Int32Array(map.n), columns = new Map();
  const middle = [0, 0];
  for (let k = 0; k < map.n; k++) {
    const i = Math.floor(at(k, 0) / cell), j = Math.floor(at(k, 1) / cell), key = j * wide + i;
    columnOf[k] = key;
    let one = columns.get(key);
    if (!one) {
      one = { i, j, layers: 0, isTop: false, isBottom: false, hasWall: false, x: 0, y: 0, n: 0 };
      columns.set(key, one);
    }
    const z = at(k, 2);
    if (z >= lowZ && z <= highZ) one.layers |= 1 << Math.min(MAX_LAYERS - 1, Math.floor((z - lowZ) / layer));
    one.isTop = one.isTop || z > highZ - LAYER_M;
    one.isBottom = one.isBottom || z < lowZ + LAYER_M;
    one.hasWall = one.hasWall || named[k] === 1;
    one.x += at(k, 0); one.y += at(k, 1); one.n++;
  }
  const all = [...columns.values()];
  for (const one of all) {
    one.x /= one.n;
    one.y /= one.n;
    middle[0] += one.x / all.length;
    middle[1] += one.y / all.length;
  }
  const nLayers = Math.max(1, Math.min(MAX_LAYERS, Math.ceil((highZ - lowZ) / layer)));
  const filled = (one) => { let n = 0; for (let bits = one.layers; bits; bits &= bits - 1) n++; return n / nLayers; };
  const isHigh = highZ - lowZ > 4 * cell;
  const walls = new Map(all.filter((one) => one.hasWall || (isHigh && filled(one) >= WALL_SHARE))
    .map((one) => [one.j * wide + one.i, one]));
  for (const one of walls.values()) one.normal = normalOf(one, walls, wide, middle);
  const share = (what) => all.filter((one) => one[what]).length / all.length;
  const hasTop = isHigh && share('isTop') > LAYER_SHARE, hasBottom = isHigh && share('isBottom') > LAYER_SHARE;
  const standing = thingsBefore(map, columnOf, walls);
  for (let k = 0; k < map.n; k++) {
    const z = at(k, 2), wall = walls.get(columnOf[k]);
    if (named[k] === 2 || (!named[k] && hasTop && z > highZ - LAYER_M)) outward[3 * k + 2] = 127;
    else if (named[k] === 3 || (!named[k] && hasBottom && z < lowZ + LAYER_M / 2)) outward[3 * k + 2] = -127;
    else if (wall && (named[k] === 1 || !standing.has(map.owner[k]))) {
      outward[3 * k] = Math.round(127 * wall.normal[0]);
      outward[3 * k + 1] = Math.round(127 * wall.normal[1]);
    }
  }
  return outward;
}

// Of each point 1, 2, 3 where it is called wall, ceiling, floor; by the truth first.
function surfacesNamed(map) {
  const kind = (name) => SURFACES.findIndex((word) => String(name).toLowerCase().split(/[^a-z]+/).includes(word)) + 1;
  const classes = map.classes.map(kind);
  const instances = map.instances.map((one) => kind(one.name) || classes[one.class] || 0);
  const ofPoint = (plane, k) => (plane ? classes[plane[k]] : 0);
  return Uint8Array.from(map.owner, (owner, k) =>
    ofPoint(map.truth, k) || ofPoint(map.classOfPoint, k) || instances[owner] || 0);
}

// Between which values along an axis, in metres from the lowest, all but a fiftieth at either end lie.
function spanOf(map, axis) {
  const values = new Uint16Array(map.n);
  for (let k = 0; k < map.n; k++) values[k] = map.positions[3 * k + axis];
  values.sort();
  const nth = (share) => values[Math.min(map.n - 1, Math.floor(share * map.n))] * map.step;
  return [nth(0.02), nth(0.98)];
}

// Across the wall that the columns around one form, away from the middle of the map.
function normalOf(one, walls, wide, middle) {
  let [n, x, y, xx, xy, yy] = [0, 0, 0, 0, 0, 0];
  for (let dj = -3; dj <= 3; dj++) {
    for (let di = -3; di <= 3; di++) {
      const other = walls.get((one.j + dj) * wide + one.i + di);
      if (!other || other.i !== one.i + di) continue;
      n++;
      [x, y] = [x + other.x, y + other.y];
      [xx, xy, yy] = [xx + other.x ** 2, xy + other.x * other.y, yy + other.y ** 2];
    }
  }
  [xx, xy, yy] = [xx / n - (x / n) ** 2, xy / n - (x * y) / n ** 2, yy / n - (y / n) ** 2];
  const away = [one.x - middle[0], one.y - middle[1]], far = Math.hypot(...away) || 1;
  const turn = 0.5 * Math.atan2(2 * xy, xx - yy), spread = Math.hypot((xx - yy) / 2, xy), mean = (xx + yy) / 2;
  if (n < 3 || mean - spread > 0.4 * (mean + spread)) return away.map((v) => v / far); // a corner, or no wall at all
  const normal = [-Math.sin(turn), Math.cos(turn)];
  return normal[0] * away[0] + normal[1] * away[1] < 0 ? normal.map((v) => -v) : normal;
}

// Instances that stand before walls rather than hang on them, and are no more than half as wide as the map.
function thingsBefore(map, columnOf, walls) {
  const inWall = new Map(), all = new Map();
  for (let k = 0; k < map.n; k++) {
    all.set(map.owner[k], (all.get(map.owner[k]) || 0) + 1);
    if (walls.has(columnOf[k])) inWall.set(map.owner[k], (inWall.get(map.owner[k]) || 0) + 1);
  }
  const half = Math.max(map.high[0] - map.low[0], map.high[1] - map.low[1]) / 2, standing = new Set();
  map.instances.forEach((one, owner) => {
    const isSmall = !one.size || Math.max(one.size[0], one.size[1]) < half;
    if (isSmall && (inWall.get(owner) || 0) < 0.7 * (all.get(owner) || 0)) standing.add(owner);
  });
  return standing;
}
