// The section of the maps: choices, the views, the list of instances, what is known of one.

const CLICK_ONE = 'Click an instance in the view or in the list to see its name, caption, scores and views.';
const GROWN = 'Each instance of the final map appears, complete, from the first frame in which it is seen; instances that '
  + 'were merged or removed earlier are not shown.';
const NO_POINTS = 'This map has no points.', DAMAGED = 'This map is damaged; build the page again.';
const MAX_READ = 6; // maps that are kept unpacked
// The maps follow the script, so that the page appears before they are loaded.
const isWhole = new Promise((done) => {
  if (document.readyState === 'loading') document.addEventListener('DOMContentLoaded', () => done(), { once: true });
  else done();
});

function mapsSection() {
  if (!DATA.maps.length) return;
  part('maps', 'Maps', 'The map of each method in each scene, downsampled for this page.', mapsContent);
}

function keysOfView(id) {
  const key = (text) => h('kbd', null, text);
  return h('p', { class: 'keys', id },
    'Hover to see a name, click or tap to select. Drag to rotate, right-drag or ', key('Shift'), '-drag to pan, ',
    'scroll to zoom after a click; pinch or drag with two fingers to zoom and pan. Keys: ', key('←↑↓→'), ' rotate, with ',
    key('Shift'), ' move, ', key('+'), ' ', key('−'), ' zoom, ', key('Home'), ' whole map, ', key('Enter'),
    ' selects the centre, ', key('N'), ' ', key('P'), ' next and previous instance, ', key('Esc'), ' clears the selection. The ',
    'address of the page stores this view: copy it to share.');
}

const sliderField = (label, value, onInput) => {
  const input = h('input', { type: 'range', min: '0', max: '100', value, id: freshId('slider'), oninput: onInput });
  return Object.assign(h('div', { class: 'field' }, h('label', { for: input.id }, label), input), { input });
};
const checkField = (text, onChange) => {
  const input = h('input', { type: 'checkbox', checked: true, id: freshId('check'), onchange: onChange });
  const label = h('label', { for: input.id }, text);
  return Object.assign(h('div', { class: 'field check' }, input, label), { input, label });
};

function mapsContent(section) {
  const scenes = [...new Set(DATA.maps.map((one) => one.scene))], sceneText = new Map(), read = new Map();
  const scene = select('Scene', scenes.map((name) => [name, name]), scenes[0], () => { listMaps(); load(); });
  const which = select('Map', [], null, () => load());
  const besideField = select('Compare with', [['', 'nothing']], '', () => showBeside());
  const colouring = select('Colour by', [], 'instance', paint), queryField = select('Text', [], null, paint);
  const cutField = sliderField('Clip height', '84', applyCut), cut = cutField.input;
  const growField = sliderField('Timeline', '0', applyGrowth), grow = growField.input;
  const missedField = checkField('Missed objects', showGhosts), wallsField = checkField('Fade near walls', applyWalls);
  const growthNote = h('p', { class: 'keys', role: 'status' });
  queryField.hidden = true;
  growField.hidden = true;

  const keys = keysOfView(freshId('keys'));
  const eye = { target: [0, 0, 0], distance: 8, azimuth: 0.7, elevation: 0.75 };
  const onMove = () => { for (const { view } of [pane, other]) if (view) view.redraw(); keepLink(); };
  const pane = mapPane({ eye, onMove, keysId: keys.id, onPick: pickAt,
    nameOf: ({ kind, owner }) => (kind === 'ghost' ? missedWords(owner) : wordsOf(pane.map, owner)) });
  const other = mapPane({ eye, onMove, keysId: keys.id, onPick: pickBeside,
    nameOf: ({ owner }) => wordsOf(other.map, owner) });
  const button = (label, text, action) => h('button', { type: 'button', class: 'plain', 'aria-label': label,
    title: label, onclick: () => pane.view && action() }, text);
  const buttons = h('div', { class: 'buttons' }, button('Zoom in', '+', () => pane.view.zoom(1 / 1.25)),
    button('Zoom out', '−', () => pane.view.zoom(1.25)), button('Whole map', 'Whole', () => pane.view.whole()));
  pane.stage.append(buttons);
  other.node.hidden = true;
  const detail = h('div', { class: 'detail', role: 'status', 'aria-label': 'Chosen instance' }), list = h('div');
  const panes = h('div', { class: 'panes' }, pane.node, other.node);
  section.append(
    h('div', { class: 'toolbar' }, scene, which, besideField, colouring, queryField, cutField, growField, missedField,
      wallsField),
    h('div', { class: 'viewer' }, h('div', null, panes, growthNote, keys), h('div', { class: 'side' }, detail, list)));

  let map = null, truth = null, current = null, picked = -1, object = -1, rows = [], listedBy = null, loads = 0, asides = 0;
  let asked = null, address = null, isWriting = null; // the address when somebody last changed something here
  const judged = () => (map && map.beside && map.beside.counted ? map.beside : null);

  function listMaps() {
    const own = DATA.maps.map((one, k) => [k, one]).filter(([, one]) => one.scene === scene.input.value);
    const before = current && DATA.maps[current.index];
    const same = before && own.find(([, one]) => one.run === before.run && one.method === before.method);
    which.setOptions(own.map(([k, one]) => [k, sideName(one.run, one.method)]), same ? same[0] : own[0][0]);
  }
  function listBeside() {
    const besides = DATA.maps.map((one, k) => [String(k), one])
      .filter(([k, one]) => one.scene === scene.input.value && Number(k) !== current.index && !one.reason)
      .map(([k, one]) => [k, sideName(one.run, one.method)]);
    const truths = map && map.beside ? [['truth', 'ground truth']] : [], before = besideField.input.value;
    besideField.setOptions([['', 'nothing'], ...truths, ...besides], asked ? asked.beside : sameBeside(before));
  }
  // The map of the same run and method in the scene that is shown now.
  function sameBeside(before) {
    const one = DATA.maps[Number(before)];
    if (before === '' || before === 'truth' || !one) return before;
    return String(mapIndex(scene.input.value, mapKey(one)));
  }
  function sceneOf(name) {
    if (!sceneText.has(name)) sceneText.set(name, JSON.parse(byId(`scene-${scenes.indexOf(name)}`).textContent));
    return sceneText.get(name);
  }
  // A map or truth, unpacked once; null where it is damaged.
  function unpacked(key, text) {
    if (!read.has(key)) read.set(key, unpackMap(text).catch(() => null));
    if (read.size > MAX_READ) read.delete(read.keys().next().value);
    return read.get(key);
  }
  const mapAt = (index) => unpacked(index, byId(`map-${index}`).textContent);
  const truthBeside = () => (map && map.beside
    ? unpacked(`${current.scene.scene} ${map.beside.truth}`, current.scene.truths[map.beside.truth]) : null);

  async function load() {
    const index = Number(which.input.value), one = DATA.maps[index], mine = ++loads;
    panes.setAttribute('aria-busy', 'true');
    if (pane.view) pane.tell('Reading the map');
    await isWhole;
    if (mine !== loads) return;
    const isOther = !current || current.scene.scene !== one.scene;
    current = { index, scene: sceneOf(one.scene) };
    picked = object = -1;
    detail.replaceChildren();
    const next = one.reason || typeof DecompressionStream === 'undefined' ? null : await mapAt(index);
    if (mine !== loads) return;
    map = next;
    truth = null;
    pane.show(map);
    if (pane.view || one.reason) pane.tell(map ? (map.n ? '' : NO_POINTS) : one.reason || DAMAGED);
    const link = asked;
    if (map) {
      const kinds = colouringsOf(map), names = kinds.map(([kind]) => kind);
      const before = link && names.includes(link.colour) ? link.colour : colouring.input.value;
      colouring.setOptions(kinds, names.includes(before) ? before : names[0]);
      const query = link && link.text !== null ? link.text : queryField.input.value;
      queryField.setOptions(map.queries.map((text, k) => [k, text]), query);
    }
    listBeside();
    asked = null;
    listedBy = null;
    setGrowth(link);
    paint();
    if (!map) list.replaceChildren();
    if (pane.view && isOther && map) pane.view.whole();
    if (link) follow(link);
    applyGrowth();
    showDetail();
    if (link && link.instance !== null) pick(link.instance, !link.camera);
    await Promise.all([showBeside(), showGhosts()]);
    if (mine !== loads) return;
    if (link && link.object !== null && link.beside === 'truth' && other.map) pickObject(link);
    if (link) follow(link);
    panes.removeAttribute('aria-busy');
  }
  // What of an address is not part of a map itself.
  function follow(link) {
    if (link.cut !== null) cut.value = String(link.cut);
    if (link.missed !== null) missedField.input.checked = link.missed && !missedField.input.disabled;
    if (link.walls !== null) wallsField.input.checked = link.walls;
    if (link.camera) Object.assign(eye, link.camera);
    applyCut();
    applyWalls();
    onMove();
  }

  async function showBeside() {
    const wanted = besideField.input.value, mine = ++asides;
    const next = wanted === 'truth' ? await truthBeside() : wanted ? await mapAt(Number(wanted)) : null;
    if (mine !== asides) return;
    const before = pane.view ? pane.view.narrowness() : 1;
    object = -1;
    other.node.hidden = !next;
    panes.classList.toggle('two', !!next);
    if (pane.view) pane.view.zoom(before / pane.view.narrowness());
    if (next && !other.view) other.open();
    other.show(next);
    paintBeside();
    applyCut();
    applyWalls();
    applyGrowth();
    keepLink();
  }
  async function showGhosts() {
    const owners = judged() ? judged().missed : [], of = map;
    const known = judged() ? owners.length : 'not known';
    missedField.label.replaceChildren(swatchOf(JUDGED[0][1]), ` Missed objects (${known})`);
    missedField.input.disabled = !owners.length;
    missedField.title = judged() ? `By the error analysis of ${judged().protocol}: objects without a mask that lies more than half in them, `
      + 'covers more than half of them, or is part of a set that makes them up' : '';
    const isWanted = owners.length > 0 && missedField.input.checked;
    const found = isWanted ? await truthBeside() : null;
    if (of !== map) return;
    truth = found;
    if (pane.view && map) pane.view.ghost(found, new Set(owners));
    keepLink();
  }
  function missedWords(index) {
    const words = truth ? wordsOf(truth, index) : null;
    return words && [words[0], 'missed by this prediction'];
  }
  function applyWalls() {
    for (const { view } of [pane, other]) if (view) view.fade(wallsField.input.checked);
    keepLink();
  }
  function applyCut() {
    if (!map) return;
    const share = Number(cut.value) / 100, height = map.low[2] + share * (map.high[2] - map.low[2]);
    cut.setAttribute('aria-valuetext', share >= 1 ? 'nothing' : `${height.toFixed(1)} m`);
    for (const { view } of [pane, other]) if (view) view.cutAt(share >= 1 ? Infinity : height);
    keepLink();
  }
  function setGrowth(link) {
    const { growth } = map || {};
    growField.hidden = growthNote.hidden = !growth;
    if (!growth) return;
    const last = growth.frame.length - 1, at = link && link.frame !== null ? stepOf(growth, link.frame) : last;
    grow.max = String(last);
    grow.value = String(at);
  }
  const stepOf = (growth, frame) => Math.max(0, growth.frame.filter((one) => one <= frame).length - 1);
  function applyGrowth() {
    const { growth } = map || {};
    if (!growth) { for (const { view } of [pane, other]) if (view) view.growTo(NO_OWNER); return; }
    const step = Number(grow.value), last = growth.frame.length - 1, frame = growth.frame[step];
    const known = map.instances.filter((one) => isNumber(one.born)), unknown = map.instances.length - known.length;
    const here = known.filter((one) => one.born <= step).length;
    const held = growth.held ? `; the method had ${growth.held[step]}` : '';
    const text = `Update ${growth.update[step]} of ${growth.update[last]}, frame ${frame}: ${here} of `
      + `${plural(map.instances.length, 'instance')} seen${held}.`;
    grow.setAttribute('aria-valuetext', text);
    growthNote.textContent = [text, GROWN, unknown ? `${unknown} without a recorded frame; always shown.` : '',
      'Points without an instance are always shown.'].filter(Boolean).join(' ');
    if (pane.view) pane.view.growTo(step);
    const beside = other.map && other.map.growth;
    if (other.view) other.view.growTo(!beside || step === last ? NO_OWNER : stepOf(beside, frame));
    keepLink();
  }
  function paint() {
    const kind = colouring.input.value;
    queryField.hidden = kind !== 'similarity';
    if (!map) return;
    const { scene: name, run, method } = DATA.maps[current.index];
    pane.paint(`${name} by ${sideName(run, method)}`, kind, Number(queryField.input.value) || 0);
    pane.choose(picked);
    paintBeside();
    if (listedBy !== orderOfList()) listInstances();
    keepLink();
  }
  // The truth has neither errors nor similarities of its own: it shows what was missed, or its classes.
  function paintBeside() {
    if (!other.map || !map) return;
    const isTruth = besideField.input.value === 'truth', one = DATA.maps[Number(besideField.input.value)];
    const asTruth = { truth: 'class', error: judged() ? 'judged' : 'class', similarity: 'class' };
    const wanted = (isTruth && asTruth[colouring.input.value]) || colouring.input.value;
    const kinds = colouringsOf(other.map).map(([kind]) => kind);
    const kind = wanted === 'judged' || kinds.includes(wanted) ? wanted : kinds[0];
    const heading = isTruth ? 'ground truth' : `by ${sideName(one.run, one.method)}`;
    other.paint(`${current.scene.scene} ${heading}`, kind, Number(queryField.input.value) || 0, judged());
  }

  const orderOfList = () => (colouring.input.value === 'similarity' ? `similarity ${queryField.input.value}` : 'own');
  function listInstances() {
    listedBy = orderOfList();
    rows = map.instances.map((one, index) => ({ one, index, selected: index === picked }));
    if (!rows.length) {
      list.replaceChildren(h('p', { class: 'intro' }, 'This map has one feature per point and no instances.'));
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
    list.replaceChildren(dataTable({ caption: 'Instances; click a row to select', filter: 'instances', tall: true, columns,
      rows, sortBy: bySimilarity ? 1 : columns.length - 1, descending: true,
      onRow: (row) => pick(row.index === picked ? -1 : row.index, true) }));
  }
  function pickAt(found) {
    if (found && found.kind === 'ghost' && truth) { pick(-1); showTruth(truth, found.owner); return; }
    pick(found ? found.owner : -1);
  }
  function pickBeside(found) {
    const isTruth = besideField.input.value === 'truth', owner = found ? found.owner : -1;
    object = isTruth ? owner : -1;
    other.choose(owner);
    keepLink();
    if (owner < 0 || !other.map) showDetail();
    else if (isTruth) showTruth(other.map, owner);
    else showFacts(other.map, owner);
  }
  const flyTo = (one) => { if (pane.view && one && one.centre) pane.view.lookAt(one.centre, Math.hypot(...one.size)); };
  // The object of the truth beside that an address asks for, by its number.
  function pickObject({ object: number, instance, camera }) {
    object = other.map.instances.findIndex((one) => one.id === number);
    other.choose(object);
    if (object < 0) return;
    if (!camera) flyTo(other.map.instances[object]);
    if (instance === null) showTruth(other.map, object);
  }
  function pick(index, fly) {
    if (!map) return;
    picked = index >= 0 && index < map.instances.length ? index : -1;
    pane.choose(picked);
    if (fly) flyTo(map.instances[picked]);
    for (const row of rows) {
      row.selected = row.index === picked;
      if (row.node) row.node.setAttribute('aria-selected', String(row.selected));
    }
    const { node } = rows[picked] || {}, box = node && node.isConnected && !fly ? node.closest('.tall') : null;
    if (box) box.scrollTop = node.offsetTop - box.clientHeight / 2;
    showDetail();
    keepLink();
  }
  function showDetail() {
    if (map && map.instances[picked]) { showFacts(map, picked); return; }
    const text = map && map.instances.length ? CLICK_ONE : 'Nothing to choose here.';
    detail.replaceChildren(h('p', { class: 'keys' }, text), h('div', null, noteList(current.scene.remarks)));
  }
  const factList = (facts) =>
    h('dl', null, facts.flatMap(([name, text]) => [h('dt', null, name), h('dd', null, text)]));
  function showFacts(of, index) {
    const one = of.instances[index];
    detail.replaceChildren(h('h3', null, titleOf(of, one)),
      h('p', null, one.caption && one.caption !== one.name ? one.caption : ''), factList(factsOfInstance(of, index)),
      viewOfInstance(of, one, current.scene.thumbnails) || '');
  }
  function showTruth(of, index) {
    detail.replaceChildren(h('h3', null, `Truth: ${titleOf(of, of.instances[index])}`),
      factList(factsOfTruth(of, index, judged())));
  }
  pane.canvas.addEventListener('keydown', (event) => {
    if (!map || event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.toLowerCase(), n = map.instances.length;
    if (key === 'n' && n) pick((picked + 1) % n);
    else if (key === 'p' && n) pick((picked + n - (picked < 0 ? 0 : 1)) % n);
    else if (event.key === 'Escape') pick(-1);
  });

  // The address follows what somebody changes here, once they pause, unless they have gone on to another one since; it
  // adds nothing to the history.
  function keepLink() {
    if (address === null || !map || asked) return;
    clearTimeout(isWriting);
    isWriting = setTimeout(() => {
      if (location.hash !== address) return;
      const { growth } = map || {}, aside = besideField.input.value, last = growth ? growth.frame.length - 1 : 0;
      const yes = (field) => (field.input.checked ? 'yes' : 'no');
      const state = {
        scene: scene.input.value, map: mapKey(DATA.maps[current.index]), colour: colouring.input.value,
        beside: aside && aside !== 'truth' ? `map:${mapKey(DATA.maps[Number(aside)])}` : aside,
        text: queryField.hidden ? null : queryField.input.value, cut: cut.value,
        frame: growth && Number(grow.value) < last ? growth.frame[Number(grow.value)] : null,
        missed: missedField.input.disabled ? null : yes(missedField), walls: yes(wallsField),
        instance: picked >= 0 ? picked : null,
        object: object >= 0 && aside === 'truth' && other.map ? other.map.instances[object].id : null,
      };
      try { history.replaceState(null, '', linkText(state, eye)); } catch (error) { /* forbidden of files somewhere */ }
      address = location.hash;
    }, 300);
  }
  for (const what of ['pointerdown', 'keydown', 'wheel', 'change', 'input', 'click']) {
    section.addEventListener(what, () => { address = location.hash; }, { capture: true, passive: true });
  }
  function followLink() {
    const link = readLink(location.hash);
    if (!link) return false;
    asked = link;
    scene.input.value = link.scene;
    listMaps();
    which.input.value = String(link.index);
    history.scrollRestoration = 'manual'; // the address says where
    section.scrollIntoView();
    return true;
  }
  window.addEventListener('hashchange', () => { if (followLink() && current) load(); });

  listMaps();
  followLink();
  // The graphics card is asked for, and the first map is read, once the view comes near the screen.
  new IntersectionObserver((entries, observer) => {
    if (!entries.some((one) => one.isIntersecting)) return;
    observer.disconnect();
    pane.open();
    if (!pane.view) buttons.remove();
    load();
  }, { rootMargin: '400px' }).observe(pane.stage);
}
