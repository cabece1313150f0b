// The sections of what goes wrong: confusion of classes, and what each kind of error costs.

const MAX_CONFUSED = 18, MAX_PAIRS = 200; // that are shown until more are asked for

function confusionSection() {
  const usable = DATA.confusions;
  if (!usable.length) return;
  part('confusion', 'Confusion', 'Rows are the true class, columns what the map calls its points, as shares of the '
    + 'row. The classes with most points come first.', (section) => {
    const names = [...new Set(usable.map((one) => one.protocol))], place = h('div');
    const protocols = protocolField(names), side = select('Method', [], null, draw);
    const amounts = [[MAX_CONFUSED, `the ${MAX_CONFUSED} largest`], [Infinity, 'all']];
    const amount = select('Classes', amounts, MAX_CONFUSED, draw);
    section.append(h('div', { class: 'toolbar' }, protocols, side, amount), place);
    chosen.listeners.push(refresh);
    function refresh() {
      const fitting = usable.map((one, k) => [k, one]).filter(([, one]) => one.protocol === protocols.protocol());
      side.setOptions(fitting.map(([k, one]) => [k, nameOf(one)]), side.input.value);
      draw();
    }
    function draw() {
      const one = usable[side.input.value];
      if (!one) return;
      const tables = one.reason ? [h('p', { class: 'note' }, one.reason)] : confusionTables(one, amount.input.value);
      place.replaceChildren(...tables);
    }
    refresh();
  });
}

const wishOf = ({ protocol, run, method }, name, called) => ({ protocol, run, method, name, called });

function confusionTables(one, most) {
  const total = new Map(), cells = new Map();
  for (const [truth, called, n] of one.cells) {
    total.set(truth, (total.get(truth) || 0) + n);
    cells.set(`${truth},${called}`, n);
  }
  const label = (k) => (k < 0 ? 'none' : one.names[k]);
  const shown = [...total.keys()].sort((a, b) => total.get(b) - total.get(a) || a - b).slice(0, Number(most));
  const columns = [...shown, -1];
  function cellOf(truth, called) {
    const n = cells.get(`${truth},${called}`) || 0, share = n / total.get(truth);
    const title = `${label(truth)} called ${label(called)}: ${percent(share)} %, ${countText(n)} points`;
    const text = share >= 0.005 ? (100 * share).toFixed(0) : '';
    const wish = wishOf(one, label(truth), label(called));
    const content = truth === called || !n ? text : toGallery(text, wish, `${title}; the worst errors of this kind`);
    const cell = h('td', { class: truth === called ? 'same' : null, title }, content);
    if (share > 0) cell.style.backgroundColor = `rgba(var(--heat), ${(0.06 + 0.84 * share).toFixed(3)})`;
    return cell;
  }
  const table = h('table', { class: 'confusion' },
    captionOf(`${nameOf(one)}, ${one.protocol}: ${shown.length < total.size ? `the ${shown.length} largest of ` : 'all '}`
      + `${total.size} true classes`),
    h('thead', null, h('tr', null, h('td'), columns.map((k) => h('th', { scope: 'col' }, h('span', null, label(k)))))),
    h('tbody', null, shown.map((truth) => h('tr', null, h('th', { scope: 'row' }, label(truth)),
      columns.map((called) => cellOf(truth, called))))));
  const wrong = one.cells.filter(([truth, called]) => truth !== called)
    .map(([truth, called, n]) => ({ truth: label(truth), called: label(called), n, share: n / total.get(truth),
      wish: wishOf(one, label(truth), label(called)) }))
    .sort((a, b) => b.n - a.n);
  return [
    h('div', { class: 'wide', tabindex: '0', role: 'region', 'aria-label': 'Confusion matrix' }, table),
    h('h3', null, 'Largest confusions'),
    dataTable({ caption: 'True class, what it is called instead, and how many points', rows: wrong,
      filter: 'classes', tall: wrong.length > 10, most: MAX_PAIRS,
      columns: [{ label: 'True class', value: (row) => row.truth, show: (row) => toGallery(row.truth, row.wish,
        `The worst errors: ${row.truth} called ${row.called}`) }, { label: 'Called', value: (row) => row.called },
        { label: 'Points', num: true, value: (row) => row.n, show: (row) => countText(row.n) },
        { label: 'Of the class', num: true, value: (row) => row.share, show: (row) => `${percent(row.share)} %` }] }),
  ];
}

const CAUSES = {
  instance: {
    merged: 'one mask holds several objects', split: 'one object lies in several masks',
    duplicate: 'a mask repeats another one’s object', mislabelled: 'the right mask, another class',
    background: 'a mask that belongs to no object', missed: 'an object that no mask is of',
  },
  semantic: {
    geometry: 'no point of the map within 5 cm', background: 'the map is there, but no mask',
    association: 'a mask that belongs to another object', label: 'the object’s own mask, another class',
  },
};

const LEFT = {
  instance: 'masks that fit badly; mask and class wrong at once', semantic: 'what no class put right brings back',
};
const STAGES = { labels: 'every mask named by the truth', '2D masks': 'masks and names of each image from the truth' };

function errorsSection() {
  if (!DATA.errors.length) return;
  part('errors', 'Errors', 'What each kind of error costs: by how many percentage points the score rises when that '
    + 'kind alone is put right and everything is scored anew. The score, the rises and the two rows below them add up '
    + 'to 100.', (section) => {
    const names = [...new Set(DATA.errors.flatMap((one) => one.protocols.map((p) => p.protocol)))];
    const reasons = DATA.errors.filter((one) => one.reason)
      .map((one) => `${nameOf(one)}: not explained: ${one.reason}`);
    if (!names.length) { fill(section, null, [noteList(reasons)]); return; }
    const place = h('div'), protocols = protocolField(names), metric = select('Metric', [], null, draw);
    section.append(h('div', { class: 'toolbar' }, protocols, metric), place);
    fill(section, null, [noteList(reasons)]);
    chosen.listeners.push(refresh);
    const explained = () => DATA.errors.flatMap((one) => one.protocols
      .filter((p) => p.protocol === protocols.protocol()).map((p) => ({ ...p, run: one.run, method: one.method })));
    function refresh() {
      const all = explained();
      if (!all.length) return;
      metric.setOptions(Object.keys(all[0].values).map((name) => [name, name]), metric.input.value);
      draw();
    }
    function draw() {
      place.replaceChildren(h('div', { class: 'wide', tabindex: '0', role: 'region', 'aria-label': 'What errors cost' },
        errorsTable(explained(), protocols.protocol(), metric.input.value)),
      h('div', null, noteList([...new Set(DATA.errors.flatMap((one) => one.remarks))])));
    }
    refresh();
  });
}

function errorsTable(all, protocol, name) {
  const gainsOf = (one) => Object.values(one.causes).map((cause) => Math.abs(cause.gains[name] || 0));
  const most = Math.max(1e-9, ...all.flatMap(gainsOf)), about = CAUSES[all[0].kind] || {};
  const bar = (value) => {
    const made = h('span', { class: value < 0 ? 'bar loss' : 'bar' });
    made.style.width = `${((Math.abs(value || 0) / most) * 4.5).toFixed(2)}rem`;
    return h('span', { class: 'barbox', 'aria-hidden': 'true' }, made);
  };
  const amount = (one, n) =>
    (one.n_scored === null ? plural(n, 'error') : `${((100 * n) / Math.max(1, one.n_scored)).toFixed(1)} % of points`);
  const row = (title, what, cell) => h('tr', null,
    h('th', { scope: 'row' }, title, what ? [h('br'), h('small', null, what)] : null),
    all.map((one) => h('td', { class: 'num' }, cell(one))));
  const costOf = (one, cause) => {
    const { gains, n } = one.causes[cause];
    const wish = { protocol, run: one.run, method: one.method, kind: cause, metric: name };
    const cost = [signed(gains[name]), bar(gains[name])];
    return [toGallery(cost, wish, `The worst errors: ${cause}, ${nameOf(one)}`), h('br'), h('small', null, amount(one, n))];
  };
  const stages = [...new Set(all.flatMap((one) => Object.keys(one.stages)))];
  return h('table', null,
    captionOf(`${protocol}: ${name}, the score in per cent and what would be added to it`),
    h('thead', null, h('tr', null, h('th', { scope: 'col' }, 'Kind of error'),
      all.map((one) => h('th', { scope: 'col', class: 'num' }, nameOf(one))))),
    h('tbody', null,
      row('As it is', null, (one) => percent(one.values[name])),
      Object.keys(all[0].causes).map((cause) => row(cause, about[cause], (one) => costOf(one, cause))),
      row('Several at once', 'what only putting several kinds right together adds or takes',
        (one) => signed(one.overlap[name])),
      row('Out of reach', LEFT[all[0].kind] || 'what is lost with every kind put right', (one) => signed(one.rest[name])),
      stages.map((stage) => row(`Score with true ${stage}`, STAGES[stage] || 'one stage replaced by the truth',
        (one) => (one.stages[stage] ? percent(one.stages[stage][name]) : '–')))));
}
