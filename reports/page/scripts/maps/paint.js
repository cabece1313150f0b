// The colours of a map's points, and what is said of them beneath the view.

const COLOURINGS = [
  ['colour', 'colour'], ['instance', 'instance'], ['class', 'class'], ['truth', 'ground-truth class'],
  ['error', 'error'], ['similarity', 'similarity to a text'],
];
const PALE = { wall: [226, 222, 214], floor: [208, 203, 196], ceiling: [236, 236, 232] };
const NOTHING = [150, 154, 160];
const HEAT = [[0, 0, 128], [0, 80, 255], [90, 215, 190], [250, 190, 40], [230, 50, 10], [128, 0, 0]];
const ERRORS = [
  ['correct class', [59, 140, 226]], ['wrong class', [224, 72, 58]], ['ground truth not scored', [176, 180, 186]],
  ['no ground truth within 5 cm', [120, 124, 132]], ['no class', [240, 176, 64]],
];
const JUDGED = [
  ['missed', [219, 41, 140]], ['not missed', [59, 140, 226]], ['not evaluated', [176, 180, 186]],
];
const MAX_ENTRIES = 300; // of a legend
const NEAR_NONE = 0xffff, NOT_SCORED = 0xfffe;

function distinct(k) {
  const [s, v] = [[0.72, 0.86], [0.55, 0.95], [0.85, 0.62]][Math.floor(k / 8) % 3];
  const hue = ((0.58 + k * 0.61803398875) % 1) * 6;
  return [5, 3, 1].map((n) => {
    const t = (n + hue) % 6;
    return Math.round(255 * (v - v * s * Math.max(0, Math.min(t, 4 - t, 1))));
  });
}
function heat(t) {
  const at = Math.max(0, Math.min(1, t)) * (HEAT.length - 1), k = Math.min(HEAT.length - 2, Math.floor(at));
  return HEAT[k].map((value, c) => Math.round(value + (HEAT[k + 1][c] - value) * (at - k)));
}

// The kinds of colours that a map has.
function colouringsOf(map) {
  const hasClass = map.classOfPoint || map.instances.some((one) => one.class !== undefined);
  const has = {
    colour: !!map.colour, instance: map.instances.length > 0, truth: !!map.truth, error: !!map.truth && hasClass,
    class: map.classOfPoint || map.instances.some((one) => one.class >= 0), similarity: map.queries.length > 0,
  };
  return COLOURINGS.filter(([kind]) => has[kind]);
}

function classAt(map, k) {
  if (map.classOfPoint) return map.classOfPoint[k] === NEAR_NONE ? -1 : map.classOfPoint[k];
  const own = map.instances[map.owner[k]];
  return own && own.class !== undefined ? own.class : -1;
}
const truthAt = (map, k) => (map.truth[k] >= NOT_SCORED ? -1 : map.truth[k]);
function errorAt(map, k) {
  if (map.truth[k] === NEAR_NONE) return 3;
  if (map.truth[k] === NOT_SCORED) return 2;
  const called = classAt(map, k);
  if (called === map.truth[k]) return 0;
  return called < 0 ? 4 : 1;
}

function judgedAt(judged, owner) {
  if (!judged || !judged.counted.includes(owner)) return 2;
  return judged.missed.includes(owner) ? 0 : 1;
}

// The colours of all points in one way, and the legend as pairs of a colour (null where there is none) and a text.
// `judged`: of a truth beside a map, which of its objects the protocol counts and the map misses.
function painted(map, kind, query, judged) {
  const colours = new Uint8Array(3 * map.n), counts = new Map();
  const count = (what) => { counts.set(what, (counts.get(what) || 0) + 1); return what; };
  const share = (n) => `${((100 * n) / Math.max(1, map.n)).toFixed(0)} %`;
  const tint = (c) => map.class_colours[c] || NOTHING; // those of the pictures
  const values = kind === 'similarity' ? map.instances.map((one) => one.similarity[query]) : [];
  const low = Math.min(...values), high = Math.max(...values);
  const owned = (k, rgb) => (map.owner[k] === NEAR_NONE ? NOTHING : rgb(map.owner[k]));
  // One object, one colour: an instance that is an object of the truth has that object's, all others none of these.
  const nObjects = map.beside ? map.beside.objects : 0;
  const same = map.instances.filter((one) => one.object).length;
  function colourOfInstance(own) {
    const one = map.instances[own] || {}, of = one.object;
    return PALE[of ? of.name : one.name] || distinct(of ? of.place : nObjects + own);
  }
  const named = () => map.instances.map((one, own) => [colourOfInstance(own), titleOf(map, one), own, one.points])
    .sort((a, b) => b[3] - a[3]).slice(0, MAX_ENTRIES);
  const nJudged = (e) => map.instances.filter((_, own) => judgedAt(judged, own) === e).length;
  const warmth = (own) => heat(high > low ? (values[own] - low) / (high - low) : 0.5);
  const paintOf = {
    colour: (k) => map.colour.subarray(3 * k, 3 * k + 3),
    instance: (k) => owned(k, colourOfInstance),
    class: (k) => tint(count(classAt(map, k))),
    truth: (k) => tint(count(truthAt(map, k))),
    error: (k) => ERRORS[count(errorAt(map, k))][1],
    similarity: (k) => owned(k, warmth),
    judged: (k) => JUDGED[count(judgedAt(judged, map.owner[k]))][1],
  }[kind];
  if (paintOf) for (let k = 0; k < map.n; k++) colours.set(paintOf(k), 3 * k);
  const classes = (none) => [...counts].sort((a, b) => b[1] - a[1])
    .map(([c, n]) => [tint(c), `${c < 0 ? none : map.classes[c]} ${share(n)}`]);
  const legendOf = {
    colour: () => [[null, 'colours from the frames']],
    instance: () => [[null, plural(map.instances.length, 'instance')
      + (same ? `; ${same} of them ${same > 1 ? 'match ground-truth objects and have their colours' : 'matches a ground-truth object and has its colour'}` : '')],
    ...named()],
    class: () => classes('none'),
    truth: () => classes('not scored or no ground truth nearby'),
    error: () => ERRORS.map(([text, rgb], e) => [rgb, `${text} ${share(counts.get(e) || 0)}`])
      .filter((_, e) => counts.get(e)),
    judged: () => JUDGED.map(([text, rgb], e) => [rgb, `${text} (${nJudged(e)})`]),
    similarity: () => [0, 0.25, 0.5, 0.75, 1].map((t) => [heat(t), ((low + t * (high - low)) / 1000).toFixed(3)]),
  }[kind];
  return { colours, legend: legendOf ? legendOf() : [] };
}

function swatchOf(rgb) {
  const swatch = h('span', { class: 'swatch' });
  swatch.style.backgroundColor = `rgb(${rgb.join(',')})`;
  return swatch;
}
function legendEntry([rgb, text, instance]) {
  if (!rgb) return h('li', null, text);
  return h('li', { 'data-instance': instance }, swatchOf(rgb), text);
}

const titleOf = (map, one) => one.name || (one.class >= 0 ? map.classes[one.class] : '') || `instance ${one.id}`;

// What is said of an instance at the pointer: its name, its class where that is another word, its score.
function wordsOf(map, index) {
  const one = map.instances[index];
  if (!one) return null;
  const title = titleOf(map, one), called = one.class >= 0 ? map.classes[one.class] : '';
  return [title, called && called !== title ? `class ${called}` : '',
    isNumber(one.score) ? `score ${one.score.toFixed(2)}` : ''].filter(Boolean);
}

// What is known of an object of the truth, as pairs of a name and a text.
function factsOfTruth(truth, index, judged) {
  const one = truth.instances[index], metres = (values, between) => values.map((v) => v.toFixed(2)).join(between);
  const facts = [['Ground-truth class', titleOf(truth, one)], ['Points', countText(one.points)]];
  if (one.size) facts.push(['Size', `${metres(one.size, ' × ')} m`], ['Centre', `${metres(one.centre, ', ')} m`]);
  if (judged && judged.counted) facts.push([`In this map (${judged.protocol})`, JUDGED[judgedAt(judged, index)][0]]);
  return facts;
}

// The true class that most scored points of an instance have, and their share of them.
function truthOfInstance(map, index) {
  const counts = new Map();
  for (let k = 0; k < map.n; k++) {
    if (map.owner[k] === index && truthAt(map, k) >= 0) counts.set(map.truth[k], (counts.get(map.truth[k]) || 0) + 1);
  }
  const [most] = [...counts].sort((a, b) => b[1] - a[1]);
  return most ? [map.classes[most[0]], most[1] / [...counts.values()].reduce((a, b) => a + b, 0)] : null;
}

// What is known of an instance, as pairs of a name and a text.
function factsOfInstance(map, index) {
  const one = map.instances[index], facts = [];
  const metres = (values, between) => values.map((v) => v.toFixed(2)).join(between);
  if (one.class !== undefined) facts.push([`Class (${map.protocol})`, one.class < 0 ? 'none' : map.classes[one.class]]);
  const truth = map.truth ? truthOfInstance(map, index) : null;
  if (map.truth) facts.push(['Ground truth', truth ? `${truth[0]} (${percent(truth[1], 0)} % of its points)` : 'none']);
  if (isNumber(one.score)) facts.push(['Score', one.score.toFixed(3)]);
  facts.push(['Points', countText(one.points)]);
  if (one.size) facts.push(['Size', `${metres(one.size, ' × ')} m`], ['Centre', `${metres(one.centre, ', ')} m`]);
  if (one.views) {
    const named = `${plural(one.n_views, 'frame')}: ${one.views.join(', ')}`;
    facts.push(['Seen in', one.n_views ? named + (one.n_views > one.views.length ? ', …' : '') : 'not recorded']);
  }
  if (one.similarity && one.similarity.length) {
    const k = one.similarity.indexOf(Math.max(...one.similarity));
    facts.push(['Most similar text', `“${map.queries[k]}” ${(one.similarity[k] / 1000).toFixed(3)}`]);
  }
  return facts;
}

// A frame in which the instance is seen, with a box around it; null where the page holds none.
function viewOfInstance(map, one, thumbnails) {
  const image = one.view !== undefined && thumbnails[one.view];
  if (!image) return null;
  const frame = h('i', { 'aria-hidden': 'true' }), [x0, y0, x1, y1] = one.box.map((v) => 100 * v);
  Object.assign(frame.style, { left: `${x0}%`, top: `${y0}%`, width: `${x1 - x0}%`, height: `${y1 - y0}%` });
  const alt = `Frame ${one.view} with ${titleOf(map, one)}`;
  return h('figure', { class: 'thumb' },
    h('div', { class: 'thumb' }, h('img', { alt, src: `data:image/jpeg;base64,${image}` }), frame),
    h('figcaption', null, `Frame ${one.view}: location of its points`));
}
