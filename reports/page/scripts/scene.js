// The section of the maps: choices, the 3D view, the list of instances, what is known of one.

const NO_VIEW = 'This browser has no WebGL 2 (or no DecompressionStream), so the maps are not drawn here. Every number '
  + 'of the page is complete without it.';
const VIEW_LOST = 'The browser took the 3D view away; it comes back by itself, or with a reload.';
const CLICK_ONE = 'Click an instance in the view or in the list to see its name, caption, scores and views.';
const DARK_PAPER = [26 / 255, 32 / 255, 39 / 255], LIGHT_PAPER = [246 / 255, 247 / 255, 249 / 255];
// The maps stand behind the script, so that the page is there before them.
const isWhole = new Promise((done) => {
  if (document.readyState === 'loading') document.addEventListener('DOMContentLoaded', () => done(), { once: true });
  else done();
});

function mapsSection() {
  if (!DATA.maps.length) return;
  part('maps', 'Maps', 'What each method made of each scene, thinned for this page.', mapsContent);
}

function keysOfView(id) {
  const key = (text) => h('kbd', null, text);
  return h('p', { class: 'keys', id },
    'Drag turns, right or ', key('Shift'), ' drag moves, the wheel zooms once the view was clicked; two fingers zoom ',
    'and move. Keys: ', key('←↑↓→'), ' turn, with ', key('Shift'), ' move, ', key('+'), ' ', key('−'), ' zoom, ',
    key('Home'), ' whole map, ', key('Enter'), ' picks the middle, ', key('N'), ' ', key('P'),
    ' next and previous instance, ', key('Esc'), ' none.');
}

function mapsContent(section) {
  const scenes = [...new Set(DATA.maps.map((one) => one.scene))], sceneText = new Map();
  const scene = select('Scene', scenes.map((name) => [name, name]), scenes[0], () => { listMaps(); load(); });
  const which = select('Map', [], null, load);
  const colouring = select('Colour by', [], 'instance', paint), queryField = select('Text', [], null, paint);
  const cut = h('input', { type: 'range', min: '0', max: '100', value: '84', id: freshId('cut'), oninput: applyCut });
  const cutField = h('div', { class: 'field' }, h('label', { for: cut.id }, 'Cut above'), cut);
  queryField.hidden = true;

  const keys = keysOfView(freshId('keys'));
  const canvas = h('canvas', { tabindex: '0', role: 'application', 'aria-label': '3D view of the map',
    'aria-describedby': keys.id });
  const say = h('div', { class: 'say', hidden: true, role: 'status' });
  const button = (label, text, action) => h('button', { type: 'button', class: 'plain', 'aria-label': label,
    title: label, onclick: () => view && action() }, text);
  const buttons = h('div', { class: 'buttons' }, button('Zoom in', '+', () => view.zoom(1 / 1.25)),
    button('Zoom out', '−', () => view.zoom(1.25)), button('Whole map', 'Whole', () => view.whole()));
  const stage = h('div', { class: 'stage' }, canvas, say, buttons);
  const legend = h('ul', { class: 'key legend', 'aria-label': 'Colours', tabindex: '0' });
  const detail = h('div', { class: 'detail', role: 'status', 'aria-label': 'Chosen instance' }), list = h('div');
  section.append(h('div', { class: 'toolbar' }, scene, which, colouring, queryField, cutField),
    h('div', { class: 'viewer' }, h('div', null, stage, legend, keys), h('div', { class: 'side' }, detail, list)));

  let view = null, map = null, current = null, picked = -1, rows = [], listedBy = null, loads = 0;
  function tell(text) { say.textContent = text; say.hidden = !text; }
  function openView() {
    try {
      const handlers = { onPick: pick, onLost: (isLost) => tell(isLost ? VIEW_LOST : '') };
      view = typeof DecompressionStream === 'undefined' ? null : mapView(canvas, handlers);
    } catch (error) { view = null; }
    if (view) return;
    canvas.remove();
    buttons.remove();
    tell(NO_VIEW);
    say.style.position = 'static';
  }

  function listMaps() {
    const own = DATA.maps.map((one, k) => [k, one]).filter(([, one]) => one.scene === scene.input.value);
    const before = current && DATA.maps[current.index];
    const same = before && own.find(([, one]) => one.run === before.run && one.method === before.method);
    which.setOptions(own.map(([k, one]) => [k, sideName(one.run, one.method)]), same ? same[0] : own[0][0]);
  }
  function sceneOf(name) {
    if (!sceneText.has(name)) sceneText.set(name, JSON.parse(byId(`scene-${scenes.indexOf(name)}`).textContent));
    return sceneText.get(name);
  }
  async function load() {
    const index = Number(which.input.value), one = DATA.maps[index], mine = ++loads;
    if (view) tell('Reading the map');
    await isWhole;
    if (mine !== loads) return;
    current = { index, scene: sceneOf(one.scene) };
    picked = -1;
    detail.replaceChildren();
    if (one.reason) { map = null; list.replaceChildren(); legend.replaceChildren(); tell(one.reason); return; }
    if (typeof DecompressionStream === 'undefined') return;
    let next = null;
    try { next = await unpackMap(byId(`map-${index}`).textContent); } catch (error) { /* said below */ }
    if (mine !== loads) return;
    if (!next) { tell('This map is damaged; make the page again.'); return; }
    map = next;
    if (view) tell(map.n ? '' : 'This map has no points.');
    const kinds = colouringsOf(map), names = kinds.map(([kind]) => kind), before = colouring.input.value;
    colouring.setOptions(kinds, names.includes(before) ? before : names[0]);
    queryField.setOptions(map.queries.map((text, k) => [k, text]), queryField.input.value);
    if (view) { view.show(map); applyCut(); }
    listedBy = null;
    paint();
    showDetail();
  }

  function applyCut() {
    if (!view || !map) return;
    const share = Number(cut.value) / 100, height = map.low[2] + share * (map.high[2] - map.low[2]);
    cut.setAttribute('aria-valuetext', share >= 1 ? 'nothing' : `${height.toFixed(1)} m`);
    view.cutAt(share >= 1 ? Infinity : height);
  }
  function paint() {
    const kind = colouring.input.value;
    queryField.hidden = kind !== 'similarity';
    if (!map) return;
    const { scene: name, method } = DATA.maps[current.index];
    const made = painted(map, kind, Number(queryField.input.value) || 0);
    if (view) view.colour(made.colours);
    legend.replaceChildren(...made.legend.map(legendEntry));
    canvas.setAttribute('aria-label', `3D view of ${name} by ${method}, coloured by ${kind}`);
    if (listedBy !== orderOfList()) listInstances();
  }

  const orderOfList = () => (colouring.input.value === 'similarity' ? `similarity ${queryField.input.value}` : 'own');
  function listInstances() {
    listedBy = orderOfList();
    rows = map.instances.map((one, index) => ({ one, index, selected: index === picked }));
    if (!rows.length) {
      list.replaceChildren(h('p', { class: 'intro' }, 'This map has one feature a point and no instances.'));
      return;
    }
    const query = Number(queryField.input.value) || 0;
    const number = (label, value, show) => ({ label, num: true, value, show });
    const columns = [{ label: 'Instance', value: (row) => titleOf(map, row.one) }];
    const likeness = (row) => row.one.similarity[query], score = (row) => row.one.score;
    const bySimilarity = colouring.input.value === 'similarity';
    if (bySimilarity) columns.push(number('Similarity', likeness, (row) => (likeness(row) / 1000).toFixed(3)));
    else if (rows.some((row) => isNumber(score(row)))) {
      columns.push(number('Score', score, (row) => (isNumber(score(row)) ? score(row).toFixed(2) : '–')));
    }
    columns.push(number('Points', (row) => row.one.points, (row) => countText(row.one.points)));
    list.replaceChildren(dataTable({ caption: 'Instances; a row chooses one', filter: 'instances', tall: true, columns,
      rows, sortBy: bySimilarity ? 1 : columns.length - 1, descending: true,
      onRow: (row) => pick(row.index === picked ? -1 : row.index, true) }));
  }
  function pick(index, fly) {
    if (!map) return;
    picked = index >= 0 && index < map.instances.length ? index : -1;
    if (view) view.choose(picked);
    const one = map.instances[picked];
    if (view && fly && one && one.centre) view.lookAt(one.centre, Math.hypot(...one.size));
    for (const row of rows) {
      row.selected = row.index === picked;
      if (row.node) row.node.setAttribute('aria-selected', String(row.selected));
    }
    const { node } = rows[picked] || {}, box = node && node.isConnected && !fly ? node.closest('.tall') : null;
    if (box) box.scrollTop = node.offsetTop - box.clientHeight / 2;
    showDetail();
  }
  function showDetail() {
    const one = map && map.instances[picked];
    if (!one) {
      const text = map && map.instances.length ? CLICK_ONE : 'Nothing to choose here.';
      detail.replaceChildren(h('p', { class: 'keys' }, text), h('div', null, noteList(current.scene.remarks)));
      return;
    }
    const facts = factsOfInstance(map, picked).flatMap(([name, text]) => [h('dt', null, name), h('dd', null, text)]);
    detail.replaceChildren(h('h3', null, titleOf(map, one)),
      h('p', null, one.caption && one.caption !== one.name ? one.caption : ''), h('dl', null, facts),
      viewOfInstance(map, one, current.scene.thumbnails) || '');
  }
  canvas.addEventListener('keydown', (event) => {
    if (!map || event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.toLowerCase(), n = map.instances.length;
    if (key === 'n' && n) pick((picked + 1) % n);
    else if (key === 'p' && n) pick((picked + n - (picked < 0 ? 0 : 1)) % n);
    else if (event.key === 'Escape') pick(-1);
  });

  const dark = window.matchMedia('(prefers-color-scheme: dark)');
  const onTheme = () => view && view.onPaper(dark.matches ? DARK_PAPER : LIGHT_PAPER);
  dark.addEventListener('change', onTheme);
  listMaps();
  // The graphics card is asked for, and the first map is read, once the view comes near the screen.
  new IntersectionObserver((entries, observer) => {
    if (!entries.some((one) => one.isIntersecting)) return;
    observer.disconnect();
    openView();
    onTheme();
    load();
  }, { rootMargin: '400px' }).observe(stage);
}
