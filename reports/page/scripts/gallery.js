// The gallery of individual errors: cards sorted by cost, linked from rows of classes and scenes, cells and bars.

const CARDS_AT_ONCE = 24;
const MORE_DIGITS = 2; // individual errors cost less than whole kinds
const gallery = { show: null };
const EVERY = ''; // the option without a filter

const costText = (value) => (isNumber(value)
  ? (value >= 0 ? '+' : '−') + Math.abs(100 * value).toFixed(MORE_DIGITS) : '–');
const isOf = (one, { run, method }) => method === undefined || (one.run === run && one.method === method);

// Whether the gallery has a card that matches {protocol, run, method, scene, kind, name, called}.
function isInGallery(wish) {
  const { scene, kind, name, called } = wish;
  return DATA.gallery.some((one) => one.protocol === wish.protocol && isOf(one, wish)
    && (!scene || one.scenes.includes(scene)) && (!kind || one.kinds.includes(kind))
    && (called ? one.pairs.some((pair) => pair[1] === called && (!name || pair[0] === name))
      : !name || one.classes.includes(name)));
}

// The text, as a link to the gallery if it has matching cards.
function toGallery(text, wish, title) {
  if (!DATA.gallery || !isInGallery(wish)) return text;
  return h('button', { type: 'button', class: 'to-gallery', title, 'aria-label': text ? null : title,
    'data-to': JSON.stringify(wish), onclick: (event) => gallery.show(wish, event.currentTarget) }, text);
}

function gallerySection() {
  if (!DATA.gallery || !DATA.gallery.length) return;
  part('gallery', 'Worst errors', 'Individual errors, most costly first. The cost is the gain of the score over all '
    + 'scenes, in percentage points, if only this error is corrected. Costs do not add up: two errors that mask each '
    + 'other cost nothing alone, and correcting several together may gain more or less than their sum.', galleryContent);
  const section = byId('gallery');
  gallery.show = (wish, from) => { makeAll(); section.show(wish, from); };
}

function galleryContent(section) {
  const names = PROTOCOLS.filter((name) => DATA.gallery.some((one) => one.protocol === name));
  const protocols = protocolField(names), metric = select('Metric', [], null, () => draw());
  const fields = {
    side: select('Method', [], null, () => draw()), scene: select('Scene', [], null, () => draw()),
    kind: select('Kind', [], null, () => draw()), name: select('Class (true or predicted)', [], null, () => draw()),
    called: select('Predicted class', [], null, () => draw()),
  };
  const back = h('button', { type: 'button', class: 'plain', hidden: true }, 'Back');
  const clear = h('button', { type: 'button', class: 'plain', onclick: () => { choose({}); draw(); } }, 'Show all');
  const status = h('p', { class: 'count', role: 'status' }), cards = h('ul', { class: 'cards' });
  const more = h('button', { type: 'button', class: 'plain', onclick: () => draw(n + CARDS_AT_ONCE) },
    'Show more');
  section.append(h('div', { class: 'toolbar' }, back, protocols, metric, Object.values(fields), clear),
    h('ul', { class: 'key' }, h('li', null, h('i', { class: 'sign area' }), 'prediction'),
      h('li', null, h('i', { class: 'sign line' }), 'ground truth')), status, cards, more);

  let n = CARDS_AT_ONCE, all = [], photos = new Map();
  const sideKey = (one) => `${one.run} ${one.method}`;
  const values = () => Object.fromEntries(Object.entries(fields).map(([key, field]) => [key, field.input.value]));
  function choose(wish) {
    const wanted = { ...wish, side: wish.method === undefined ? EVERY : sideKey(wish) };
    for (const [key, field] of Object.entries(fields)) field.input.value = wanted[key] || EVERY;
  }
  function own() { return all.filter((one) => one.protocol === protocols.protocol()); }
  function refresh() {
    const mine = own(), before = values();
    const [first] = mine, metrics = first ? first.metrics : [];
    metric.setOptions(metrics.map((name) => [name, name]), metric.input.value);
    const offer = (key, label, texts) => {
      const pairs = texts.map((one) => (Array.isArray(one) ? one : [one, one]));
      fields[key].setOptions([[EVERY, label], ...pairs], before[key]);
    };
    const classes = (...of) => [...new Set(mine.flatMap((one) => of.flatMap((what) => one[what])))]
      .sort((a, b) => a.localeCompare(b, 'en'));
    offer('side', 'all methods', [...new Map(mine.map((one) => [sideKey(one), nameOf(one)]))]);
    offer('scene', 'all scenes', [...new Set(mine.map((one) => one.scene))]);
    offer('kind', 'all kinds', [...new Set(mine.map((one) => one.kind))].sort());
    offer('name', 'all classes', classes('true', 'called'));
    offer('called', 'all classes', classes('called'));
    draw();
  }
  function fitting() {
    const { side, scene, kind, name, called } = values(), place = own()[0]?.metrics.indexOf(metric.input.value);
    const cost = (one) => (isNumber(one.gains[place]) ? one.gains[place] : -Infinity);
    return own().filter((one) => (!side || sideKey(one) === side) && (!scene || one.scene === scene)
      && (!kind || one.kind === kind) && (!name || one.true.includes(name) || one.called.includes(name))
      && (!called || one.called.includes(called)))
      .map((one) => ({ ...one, cost: cost(one) })).sort((a, b) => b.cost - a.cost);
  }
  function draw(most = CARDS_AT_ONCE) {
    n = most;
    const found = fitting(), shown = found.slice(0, n), withPhoto = found.filter((one) => one.photo !== null).length;
    const { side, scene } = values();
    const lists = DATA.gallery.filter((one) => one.protocol === protocols.protocol() && (!side || sideKey(one) === side));
    const sum = (what) => lists.reduce((total, one) => total
      + one[what].reduce((part, value, k) => part + (!scene || one.scenes[k] === scene ? value : 0), 0), 0);
    const listed = sum('listed'), there = sum('n');
    status.textContent = `${shown.length} of ${plural(found.length, 'error')}, ${withPhoto} with a photo`
      + (listed < there ? `; only the ${listed} most costly of ${there} are listed` : '');
    cards.replaceChildren(...shown.map((one) => cardOf(one, metric.input.value, photos.get(one.scene))));
    more.hidden = shown.length === found.length;
  }
  section.show = async (wish, from) => {
    const origin = from.closest('section.part'), key = from.dataset.to;
    await ready;
    if (wish.protocol !== protocols.protocol()) {
      chosen.protocol = wish.protocol;
      chosen.listeners.forEach((listen) => listen(wish.protocol));
    }
    choose(wish);
    if (wish.metric && [...metric.input.options].some((one) => one.value === wish.metric)) {
      metric.input.value = wish.metric;
    }
    draw();
    back.hidden = false;
    back.textContent = `Back to ${origin.querySelector('h2').textContent}`;
    back.onclick = () => {
      back.hidden = true;
      const there = [...origin.querySelectorAll('.to-gallery')].find((one) => one.dataset.to === key);
      const target = there || origin.querySelector('select, button') || origin;
      target.focus({ preventScroll: true });
      target.scrollIntoView({ block: 'center' });
    };
    section.scrollIntoView();
    back.focus({ preventScroll: true });
  };
  const ready = isWhole.then(() => {
    for (const node of document.querySelectorAll('script.gallery')) {
      const one = JSON.parse(node.textContent);
      photos.set(one.scene, one.photos);
      for (const { cards: own, ...of } of one.of_methods) {
        all.push(...own.map((card) => ({ ...card, scene: one.scene, run: of.run, method: of.method,
          protocol: of.protocol, metrics: of.metrics, family: of.kind, truth: of.truth })));
      }
    }
    chosen.listeners.push(refresh);
    refresh();
  });
}

function cardTitle(one) {
  const names = (list) => list.join(' + '), called = one.called.filter((name) => name !== 'none');
  if (!one.true.length) return `${names(called) || 'mask'} without a ground-truth object`;
  return `${names(one.true)}, predicted as ${names(called) || 'nothing'}`;
}

function cardOf(one, metric, photos) {
  const about = (CAUSES[one.family] || {})[one.kind], facts = [];
  const fact = (what, text) => facts.push(h('dt', null, what), h('dd', null, text));
  fact('Scene', one.scene);
  fact('Method', nameOf(one));
  if (one.family === 'semantic') {
    const share = percent(one.n_points / Math.max(1, one.n_true), 0);
    fact('Points', `${countText(one.n_points)}, ${share} % of the object`);
  } else {
    if (isNumber(one.score)) fact('Score', String(one.score));
    fact('IoU', isNumber(one.iou) ? one.iou.toFixed(2) : '–');
  }
  if (one.ids.length) fact(one.ids.length > 1 ? 'Instances' : 'Instance', one.ids.join(', '));
  fact('Costs', one.metrics.map((name, k) => `${name} ${costText(one.gains[k])}`).join(', '));
  const alt = `Frame ${one.frame} of ${one.scene}: ${cardTitle(one)}`, link = linkToError(one);
  const photo = one.photo === null ? h('p', { class: 'no-photo' }, `No photo: ${one.why}`)
    : h('figure', null, h('img', { src: `data:image/jpeg;base64,${photos[one.photo]}`, alt, width: 256, height: 192 }),
      h('figcaption', null, `frame ${one.frame}`));
  return h('li', { class: 'card' }, photo,
    h('p', { class: 'cost' }, h('b', null, costText(one.cost)), ` ${metric}`,
      h('span', { class: 'mark', title: about }, one.kind)),
    h('h3', null, cardTitle(one)), h('dl', null, facts), link
      ? h('a', { class: 'to-map', href: link, 'aria-label': `Show in the map: ${cardTitle(one)}` }, 'Show in the map')
      : null);
}
