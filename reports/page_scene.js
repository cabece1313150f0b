// The section of the maps: choices, the 3D view, the list of instances, what is known of one.

const COLOURINGS = [['colour', 'colour'], ['instance', 'instance'], ['class', 'class'], ['truth', 'true class'], ['error', 'error against the truth'], ['similarity', 'similarity to a text']];
const PALE = { wall: [226, 222, 214], floor: [208, 203, 196], ceiling: [236, 236, 232] };
const NOTHING = [150, 154, 160], GOOD = [59, 140, 226], WRONG = [224, 72, 58], UNKNOWN = [176, 180, 186];
const HEAT = [[0, 0, 128], [0, 80, 255], [90, 215, 190], [250, 190, 40], [230, 50, 10], [128, 0, 0]];
const NEAR_NONE = 0xffff, NOT_SCORED = 0xfffe;

function distinct(k) {
  const [s, v] = [[0.72, 0.86], [0.55, 0.95], [0.85, 0.62]][Math.floor(k / 8) % 3], hue = ((0.58 + k * 0.61803398875) % 1) * 6;
  return [5, 3, 1].map((n) => { const t = (n + hue) % 6; return Math.round(255 * (v - v * s * Math.max(0, Math.min(t, 4 - t, 1)))); });
}
function heat(t) {
  const at = Math.max(0, Math.min(1, t)) * (HEAT.length - 1), k = Math.min(HEAT.length - 2, Math.floor(at));
  return HEAT[k].map((value, c) => Math.round(value + (HEAT[k + 1][c] - value) * (at - k)));
}

function mapsSection() {
  if (!DATA.maps.length) return;
  const section = part('maps', 'Maps', 'What each method made of each scene, thinned for this page.');
  const scenes = [...new Set(DATA.maps.map((one) => one.scene))], sceneText = new Map();
  const scene = select('Scene', scenes.map((name) => [name, name]), scenes[0], () => { listMaps(); load(); });
  const which = select('Map', [], null, load);
  const colouring = select('Colour by', [], 'instance', () => { queryField.hidden = colouring.input.value !== 'similarity'; paint(); });
  const queryField = select('Text', [], null, paint);
  const cut = h('input', { type: 'range', min: '0', max: '100', value: '84', id: freshId('cut'), oninput: applyCut });
  const cutField = h('div', { class: 'field' }, h('label', { for: cut.id }, 'Cut above'), cut);
  queryField.hidden = true;

  const keysId = freshId('keys');
  const canvas = h('canvas', { tabindex: '0', role: 'application', 'aria-label': '3D view of the map', 'aria-describedby': keysId });
  const say = h('div', { class: 'say', hidden: true, role: 'status' });
  const button = (label, text, action) => h('button', { type: 'button', class: 'plain', 'aria-label': label, title: label, onclick: action }, text);
  const buttons = h('div', { class: 'buttons' }, button('Zoom in', '+', () => view.zoom(1 / 1.25)), button('Zoom out', '−', () => view.zoom(1.25)), button('Whole map', 'Whole', () => view.whole()));
  const stage = h('div', { class: 'stage' }, canvas, say, buttons);
  const legend = h('ul', { class: 'key legend', 'aria-label': 'Colours', tabindex: '0' });
  const keys = h('p', { class: 'keys', id: keysId }, 'Drag turns, right or ', h('kbd', null, 'Shift'), ' drag moves, the wheel zooms once the view was clicked; two fingers zoom and move. Keys: ',
    h('kbd', null, '←↑↓→'), ' turn, with ', h('kbd', null, 'Shift'), ' move, ', h('kbd', null, '+'), ' ', h('kbd', null, '−'), ' zoom, ', h('kbd', null, 'Home'), ' whole map, ', h('kbd', null, 'Enter'),
    ' picks the middle, ', h('kbd', null, 'N'), ' ', h('kbd', null, 'P'), ' next and previous instance, ', h('kbd', null, 'Esc'), ' none.');
  const detail = h('div', { class: 'detail', role: 'status', 'aria-label': 'Chosen instance' }), list = h('div');
  section.append(h('div', { class: 'toolbar' }, scene, which, colouring, queryField, cutField),
    h('div', { class: 'viewer' }, h('div', null, stage, legend, keys), h('div', { class: 'side' }, detail, list)));

  let view = null, map = null, current = null, picked = -1, rows = [], loads = 0;
  try {
    view = typeof DecompressionStream === 'undefined' ? null : mapView(canvas, { onPick: pick, onLost: (lost) => tell(lost ? 'The browser took the 3D view away; it comes back by itself, or with a reload.' : '') });
  } catch (error) { view = null; }
  if (!view) {
    canvas.hidden = true;
    canvas.remove();
    buttons.remove();
    stage.classList.add('without');
    say.textContent = 'This browser has no WebGL 2 (or no DecompressionStream), so the maps are not drawn here. Every number of the page is complete without it.';
    say.hidden = false;
    say.style.position = 'static';
  }
  function tell(text) { say.textContent = text; say.hidden = !text; }

  function listMaps() {
    const own = DATA.maps.map((one, k) => [k, one]).filter(([, one]) => one.scene === scene.input.value);
    const before = current && DATA.maps[current.index];
    const same = before && own.find(([, one]) => one.run === before.run && one.method === before.method);
    which.setOptions(own.map(([k, one]) => [k, sideName(one.run, one.method)]), same ? same[0] : own[0][0]);
  }
  function sceneOf(name) {
    if (!sceneText.has(name)) {
      const index = scenes.indexOf(name);
      sceneText.set(name, JSON.parse(byId(`scene-${index}`).textContent));
    }
    return sceneText.get(name);
  }

  async function load() {
    const index = Number(which.input.value), one = DATA.maps[index], mine = ++loads;
    current = { index, scene: sceneOf(one.scene) };
    picked = -1;
    detail.replaceChildren();
    if (one.reason) { map = null; list.replaceChildren(); legend.replaceChildren(); tell(one.reason); return; }
    if (typeof DecompressionStream === 'undefined') return;
    if (view) tell('Reading the map');
    let next;
    try { next = await unpackMap(byId(`map-${index}`).textContent); } catch (error) { if (mine === loads) tell('This map is damaged; make the page again.'); return; }
    if (mine !== loads) return;
    map = next;
    if (view) tell(map.n ? '' : 'This map has no points.');
    const has = { colour: !!map.colour, instance: map.instances.length > 0, class: map.classOfPoint || map.instances.some((each) => each.class >= 0),
      truth: !!map.truth, error: !!map.truth && (map.classOfPoint || map.instances.some((each) => each.class !== undefined)), similarity: map.queries.length > 0 };
    const options = COLOURINGS.filter(([key]) => has[key]);
    const wanted = has[colouring.input.value] ? colouring.input.value : has.colour ? 'colour' : (options[0] || [''])[0];
    colouring.setOptions(options, wanted);
    queryField.setOptions(map.queries.map((text, k) => [k, text]), queryField.input.value);
    queryField.hidden = colouring.input.value !== 'similarity';
    if (view) { view.show(map); applyCut(); }
    paint();
    listInstances();
    showDetail();
  }

  function applyCut() {
    if (!view || !map) return;
    const share = Number(cut.value) / 100, height = map.low[2] + share * (map.high[2] - map.low[2]);
    cut.setAttribute('aria-valuetext', share >= 1 ? 'nothing' : `${height.toFixed(1)} m`);
    view.cutAt(share >= 1 ? Infinity : height);
  }

  const classAt = (k) => { if (map.classOfPoint) return map.classOfPoint[k] === NEAR_NONE ? -1 : map.classOfPoint[k]; const own = map.instances[map.owner[k]]; return own && own.class !== undefined ? own.class : -1; };
  const mapName = (k) => { const own = map.instances[map.owner[k]]; return own ? own.name : undefined; };
  const errorAt = (k) => { const truth = map.truth[k]; if (truth === NEAR_NONE) return 3; if (truth === NOT_SCORED) return 2; const called = classAt(k); return called === truth ? 0 : called < 0 ? 4 : 1; };

  function paint() {
    if (!map) return;
    const kind = colouring.input.value, colours = new Uint8Array(3 * map.n), counts = new Map();
    const order = classOrder(), classTint = (c) => (c < 0 || c >= map.classes.length ? NOTHING : PALE[map.classes[c]] || distinct(order.get(c) ?? c));
    let low = Infinity, high = -Infinity;
    const query = Number(queryField.input.value) || 0;
    if (kind === 'similarity') for (const each of map.instances) { low = Math.min(low, each.similarity[query]); high = Math.max(high, each.similarity[query]); }
    const errors = [GOOD, WRONG, UNKNOWN, [120, 124, 132], [240, 176, 64]];
    const paintOf = {
      colour: (k) => [map.colour[3 * k], map.colour[3 * k + 1], map.colour[3 * k + 2]],
      instance: (k) => (map.owner[k] === NEAR_NONE ? NOTHING : PALE[mapName(k)] || distinct(map.owner[k])),
      class: (k) => { const c = classAt(k); counts.set(c, (counts.get(c) || 0) + 1); return classTint(c); },
      truth: (k) => { const c = map.truth[k] >= NOT_SCORED ? -1 : map.truth[k]; counts.set(c, (counts.get(c) || 0) + 1); return classTint(c); },
      error: (k) => { const e = errorAt(k); counts.set(e, (counts.get(e) || 0) + 1); return errors[e]; },
      similarity: (k) => (map.owner[k] === NEAR_NONE ? NOTHING : heat(high > low ? (map.instances[map.owner[k]].similarity[query] - low) / (high - low) : 0.5)),
    }[kind];
    if (paintOf) for (let k = 0; k < map.n; k++) colours.set(paintOf(k), 3 * k);
    if (view) view.colour(colours);
    const entry = (rgb, text) => { const swatch = h('span', { class: 'swatch' }); swatch.style.backgroundColor = `rgb(${rgb.join(',')})`; return h('li', null, swatch, text); };
    const share = (n) => `${((100 * n) / Math.max(1, map.n)).toFixed(0)} %`;
    const byCount = [...counts].sort((a, b) => b[1] - a[1]);
    legend.replaceChildren(...({
      class: () => byCount.map(([c, n]) => entry(classTint(c), `${c < 0 ? 'none' : map.classes[c]} ${share(n)}`)),
      truth: () => byCount.map(([c, n]) => entry(classTint(c), `${c < 0 ? 'not scored or nothing near' : map.classes[c]} ${share(n)}`)),
      error: () => ['right class', 'wrong class', 'truth not scored', 'no truth within 5 cm', 'no class'].map((text, e) => (counts.get(e) ? entry(errors[e], `${text} ${share(counts.get(e))}`) : null)).filter(Boolean),
      similarity: () => [0, 0.25, 0.5, 0.75, 1].map((t) => entry(heat(t), ((low + t * (high - low)) / 1000).toFixed(3))),
      instance: () => [h('li', null, plural(map.instances.length, 'instance'))], colour: () => [h('li', null, 'as the frames saw it')],
    }[kind] || (() => []))());
    canvas.setAttribute('aria-label', `3D view of ${DATA.maps[current.index].scene} by ${DATA.maps[current.index].method}, coloured by ${kind}`);
    if (kind === 'similarity' && rows.length) listInstances();
  }
  function classOrder() {
    // The classes of the truth, else of the map, by their points: the first ones get the most distinct colours.
    if (map.order) return map.order;
    const counts = new Map();
    for (let k = 0; k < map.n; k++) { const c = map.truth && map.truth[k] < NOT_SCORED ? map.truth[k] : classAt(k); counts.set(c, (counts.get(c) || 0) + 1); }
    map.order = new Map([...counts].filter(([c]) => c >= 0 && !PALE[map.classes[c]]).sort((a, b) => b[1] - a[1]).map(([c], place) => [c, place]));
    return map.order;
  }

  const title = (one) => one.name || (one.class >= 0 ? map.classes[one.class] : '') || `instance ${one.id}`;
  const truthOf = (k) => {
    if (!map.truth) return null;
    const counts = new Map();
    for (let i = 0; i < map.n; i++) if (map.owner[i] === k && map.truth[i] < NOT_SCORED) counts.set(map.truth[i], (counts.get(map.truth[i]) || 0) + 1);
    const most = [...counts].sort((a, b) => b[1] - a[1])[0];
    return most ? [map.classes[most[0]], most[1] / [...counts.values()].reduce((a, b) => a + b, 0)] : null;
  };
  function listInstances() {
    rows = map.instances.map((one, index) => ({ one, index, selected: index === picked }));
    if (!rows.length) { list.replaceChildren(h('p', { class: 'intro' }, 'This map has one feature a point and no instances.')); return; }
    const query = Number(queryField.input.value) || 0, bySimilarity = colouring.input.value === 'similarity' && map.queries.length;
    const columns = [{ label: 'Instance', value: (row) => title(row.one) }];
    if (bySimilarity) columns.push({ label: 'Similarity', num: true, value: (row) => row.one.similarity[query], show: (row) => (row.one.similarity[query] / 1000).toFixed(3) });
    else if (rows.some((row) => isNumber(row.one.score))) columns.push({ label: 'Score', num: true, value: (row) => row.one.score, show: (row) => (isNumber(row.one.score) ? row.one.score.toFixed(2) : '–') });
    columns.push({ label: 'Points', num: true, value: (row) => row.one.points, show: (row) => countText(row.one.points) });
    list.replaceChildren(dataTable({ caption: 'Instances; a row chooses one', filter: 'instances', tall: true, columns, rows, sortBy: bySimilarity ? 1 : columns.length - 1, descending: true, onRow: (row) => pick(row.index === picked ? -1 : row.index, true) }));
  }
  function pick(index, fly) {
    if (!map) return;
    picked = index >= 0 && index < map.instances.length ? index : -1;
    if (view) view.choose(picked);
    const one = map.instances[picked];
    if (view && fly && one && one.centre) view.lookAt(one.centre, Math.hypot(...one.size));
    rows.forEach((row) => { row.selected = row.index === picked; if (row.node) row.node.setAttribute('aria-selected', String(row.selected)); });
    const chosenRow = rows[picked];
    if (chosenRow && chosenRow.node && chosenRow.node.isConnected && !fly) {
      const box = chosenRow.node.closest('.tall');
      if (box) box.scrollTop = chosenRow.node.offsetTop - box.clientHeight / 2;
    }
    showDetail();
  }
  function showDetail() {
    const one = map && map.instances[picked];
    if (!one) {
      detail.replaceChildren(h('p', { class: 'keys' }, map && map.instances.length ? 'Click an instance in the view or in the list to see its name, caption, scores and views.' : 'Nothing to choose here.'),
        h('div', null, noteList(current.scene.remarks)));
      return;
    }
    const truth = truthOf(picked), facts = [];
    if (one.class !== undefined) facts.push([`Class (${map.protocol})`, one.class < 0 ? 'none' : map.classes[one.class]]);
    if (map.truth) facts.push(['Truth there', truth ? `${truth[0]} (${percent(truth[1], 0)} % of its points)` : 'none']);
    if (isNumber(one.score)) facts.push(['Score', one.score.toFixed(3)]);
    facts.push(['Points', countText(one.points)]);
    if (one.size) facts.push(['Size', `${one.size.map((v) => v.toFixed(2)).join(' × ')} m`], ['Centre', `${one.centre.map((v) => v.toFixed(2)).join(', ')} m`]);
    if (one.views) facts.push(['Seen in', one.n_views ? `${plural(one.n_views, 'frame')}: ${one.views.join(', ')}${one.n_views > one.views.length ? ', …' : ''}` : 'not recorded']);
    if (one.similarity) { const k = one.similarity.indexOf(Math.max(...one.similarity)); facts.push(['Most like', `“${map.queries[k]}” ${(one.similarity[k] / 1000).toFixed(3)}`]); }
    const image = one.view !== undefined && current.scene.thumbnails[one.view];
    let picture = null;
    if (image) {
      const frame = h('i', { 'aria-hidden': 'true' }), [x0, y0, x1, y1] = one.box;
      Object.assign(frame.style, { left: `${100 * x0}%`, top: `${100 * y0}%`, width: `${100 * (x1 - x0)}%`, height: `${100 * (y1 - y0)}%` });
      picture = h('figure', { class: 'thumb' }, h('div', { class: 'thumb' }, h('img', { alt: `Frame ${one.view} with ${title(one)}`, src: `data:image/jpeg;base64,${image}` }), frame), h('figcaption', null, `Frame ${one.view}: where its points are`));
    }
    detail.replaceChildren(h('h3', null, title(one)), h('p', null, one.caption && one.caption !== one.name ? one.caption : ''), h('dl', null, facts.flatMap(([name, text]) => [h('dt', null, name), h('dd', null, text)])), picture || '');
  }
  canvas.addEventListener('keydown', (event) => {
    if (!map || event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.toLowerCase(), n = map.instances.length;
    if (key === 'n' && n) pick((picked + 1) % n);
    else if (key === 'p' && n) pick((picked + n - (picked < 0 ? 0 : 1)) % n);
    else if (event.key === 'Escape') pick(-1);
  });

  const dark = window.matchMedia('(prefers-color-scheme: dark)');
  const onTheme = () => view && view.onPaper(dark.matches ? [26 / 255, 32 / 255, 39 / 255] : [246 / 255, 247 / 255, 249 / 255]);
  dark.addEventListener('change', onTheme);
  onTheme();
  listMaps();
  // The first map is read once it comes near the screen, so that the page itself opens at once.
  new IntersectionObserver((entries, observer) => { if (entries.some((one) => one.isIntersecting)) { observer.disconnect(); load(); } }, { rootMargin: '400px' }).observe(section);
}
