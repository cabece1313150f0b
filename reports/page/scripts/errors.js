// The sections Confusion (of classes) and Errors (cost of each kind of error).

const MAX_CONFUSED = 18, MAX_PAIRS = 200; // shown by default

function confusionSection() {
  const usable = DATA.confusions;
  if (!usable.length) return;
  part('confusion', 'Confusion', 'Rows are ground-truth classes, columns predicted classes; each cell is the '
    + 'percentage of the points of its row. The classes with the most points come first.', (section) => {
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
    const title = `${label(truth)} predicted as ${label(called)}: ${percent(share)} %, ${countText(n)} points`;
    const text = share >= 0.005 ? (100 * share).toFixed(0) : '';
    const wish = wishOf(one, label(truth), label(called));
    const content = truth === called || !n ? text : toGallery(text, wish, `${title}; show the worst errors of this kind`);
    const cell = h('td', { class: truth === called ? 'same' : null, title }, content);
    if (share > 0) cell.style.backgroundColor = `rgba(var(--heat), ${(0.06 + 0.84 * share).toFixed(3)})`;
    return cell;
  }
  const table = h('table', { class: 'confusion' },
    captionOf(`${nameOf(one)}, ${one.protocol}: ${shown.length < total.size ? `the ${shown.length} largest of ` : 'all '}`
      + `${total.size} ground-truth classes`),
    h('thead', null, h('tr', null, h('td'), columns.map((k) => h('th', { scope: 'col' }, h('span', null, label(k)))))),
    h('tbody', null, shown.map((truth) => h('tr', null, h('th', { scope: 'row' }, label(truth)),
      columns.map((called) => cellOf(truth, called))))));
  const wrong = one.cells.filter(([truth, called]) => truth !== called)
    .map(([truth, called, n]) => ({ truth: label(truth), called: label(called), n, share: n / total.get(truth),
      wish: wishOf(one, label(truth), label(called)) }))
    .sort((a, b) => b.n - a.n);
  return [
    ...scrollBox('Confusion matrix', table), csvButton(`confusion ${nameOf(one)} ${one.protocol}`, () => [
      ['ground truth', 'prediction', 'points'], ...one.cells.map(([truth, called, n]) => [label(truth), label(called), n])]),
    h('h3', null, 'Largest confusions'),
    dataTable({ caption: 'Ground-truth class, wrong predicted class, number of points', rows: wrong,
      filter: 'classes', tall: wrong.length > 10, most: MAX_PAIRS,
      columns: [{ label: 'Ground truth', value: (row) => row.truth, show: (row) => toGallery(row.truth, row.wish,
        `Worst errors: ${row.truth} predicted as ${row.called}`) },
        { label: 'Prediction', value: (row) => row.called },
        { label: 'Points', num: true, value: (row) => row.n, show: (row) => countText(row.n) },
        { label: 'Share of the class', num: true, value: (row) => row.share, show: (row) => `${percent(row.share)} %` }] }),
  ];
}

const CAUSES = {
  instance: {
    merged: 'one mask covers several objects', split: 'one object is split over several masks',
    duplicate: 'a further mask of the same object', mislabelled: 'correct mask, wrong class',
    background: 'a mask without an object', missed: 'an object without a mask',
  },
  semantic: {
    geometry: 'no map point within 5 cm', background: 'map point nearby, but in no mask',
    association: 'in the mask of another object', label: 'in the object’s own mask, wrong class',
  },
};

const LEFT = {
  instance: 'inaccurate masks; mask and class both wrong', semantic: 'classes that correcting points does not recover',
};
const STAGES = { labels: 'each mask labelled from ground truth', '2D masks': '2D masks and labels from ground truth' };

function errorsSection() {
  if (!DATA.errors.length) return;
  part('errors', 'Errors', 'Cost of each kind of error: the gain in percentage points if only that kind is corrected '
    + 'and everything is scored again. The score, the gains and the two rows below them add up to 100.', (section) => {
    const names = [...new Set(DATA.errors.flatMap((one) => one.protocols.map((p) => p.protocol)))];
    const reasons = DATA.errors.filter((one) => one.reason)
      .map((one) => `${nameOf(one)}: no error analysis: ${one.reason}`);
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
      const table = errorsTable(explained(), protocols.protocol(), metric.input.value);
      place.replaceChildren(...scrollBox('Cost of errors', table),
        csvButton(`cost of errors ${protocols.protocol()} ${metric.input.value}`,
          () => errorsLines(explained(), metric.input.value)),
        h('div', null, noteList([...new Set(DATA.errors.flatMap((one) => one.remarks))])));
    }
    refresh();
  });
}

function errorsLines(all, name) {
  const costs = (one) => Object.entries(one.causes).map(([cause, { gains, n }]) => [cause, gains[name], n]);
  const stages = (one) => Object.entries(one.stages).map(([stage, values]) => [`score with GT ${stage}`, values[name]]);
  return [['method', 'kind', name, 'errors'], ...all.flatMap((one) => [['score', one.values[name]], ...costs(one),
    ['interaction', one.overlap[name]], ['remaining', one.rest[name]], ...stages(one)].map((line) => [nameOf(one), ...line]))];
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
    return [toGallery(cost, wish, `Worst errors: ${cause}, ${nameOf(one)}`), h('br'), h('small', null, amount(one, n))];
  };
  const stages = [...new Set(all.flatMap((one) => Object.keys(one.stages)))];
  const costs = (cause) => Math.max(...all.map((one) => one.causes[cause].gains[name] || 0));
  const causes = Object.keys(all[0].causes).sort((a, b) => costs(b) - costs(a));
  return h('table', null,
    captionOf(`${protocol}: ${name} in per cent, and gains in percentage points`),
    h('thead', null, h('tr', null, h('th', { scope: 'col' }, 'Kind of error'),
      all.map((one) => h('th', { scope: 'col', class: 'num' }, nameOf(one))))),
    h('tbody', null,
      row('Score', null, (one) => percent(one.values[name])),
      causes.map((cause) => row(cause, about[cause], (one) => costOf(one, cause))),
      row('Interaction', 'all corrected together, minus the sum of the gains',
        (one) => signed(one.overlap[name])),
      row('Remaining', LEFT[all[0].kind] || 'lost even if every kind is corrected', (one) => signed(one.rest[name])),
      stages.map((stage) => row(`Score with ground-truth ${stage}`, STAGES[stage] || 'one stage from ground truth',
        (one) => (one.stages[stage] ? percent(one.stages[stage][name]) : '–')))));
}
