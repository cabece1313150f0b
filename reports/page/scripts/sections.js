// The sections Summary, Scenes and Classes, and functions that all sections share. DATA is collected by
// su3d_bench/analysis/page.

const DATA = JSON.parse(byId('data').textContent);
const RUNS = DATA.runs;
const SWEEPS = DATA.robustness || [];
const shortName = (name) => name.replace(/[\\/]+$/, '').split(/[\\/]/).pop();
const runNames = RUNS.map((run, k) => {
  const name = shortName(run.name);
  return RUNS.some((other, j) => j !== k && shortName(other.name) === name) ? run.name : name;
});
const sideName = (run, method) => (RUNS.length > 1 ? `${method} (${runNames[run]})` : method);
const SIDES = [];
for (const one of DATA.results) {
  if (!SIDES.some((side) => side.run === one.run && side.method === one.method)) {
    SIDES.push({ run: one.run, method: one.method, name: sideName(one.run, one.method), style: SIDES.length });
  }
}
for (const [run, { methods }] of RUNS.entries()) {
  for (const method of methods) {  // methods without scores are listed too
    if (!SIDES.some((side) => side.run === run && side.method === method)) {
      SIDES.push({ run, method, name: sideName(run, method), style: SIDES.length });
    }
  }
}
const PROTOCOLS = [...new Set(DATA.results.map((one) => one.protocol))];
const resultsOf = (protocol) => DATA.results.filter((one) => one.protocol === protocol);
const nameOf = (one) => sideName(one.run, one.method);
const styleOf = (run, method) => SIDES.findIndex((side) => side.run === run && side.method === method);

// A section appears immediately with its heading; its content is built when the browser is idle, or on demand.
const unmade = new Map();
function part(id, title, intro, make) {
  const section = h('section', { class: 'part', id, 'aria-labelledby': `${id}-title` },
    h('h2', { id: `${id}-title` }, title), intro ? h('p', { class: 'intro' }, intro) : null);
  byId('nav').append(h('a', { href: `#${id}` }, title));
  byId('main').append(section);
  unmade.set(section, make);
}
function makePart(section) {
  const make = unmade.get(section);
  if (!make) return;
  unmade.delete(section);
  make(section);
  if (unmade.size) return;
  byId('main').removeAttribute('aria-busy');
  performance.mark('su3d-whole');
}
function makeAll() {
  for (const section of [...unmade.keys()]) makePart(section);
}

// The selected protocol is shared by all sections.
const chosen = { protocol: PROTOCOLS[0], listeners: [] };
function protocolField(protocols) {
  const field = select('Protocol', protocols.map((name) => [name, name]), chosen.protocol, (name) => {
    chosen.protocol = name;
    chosen.listeners.forEach((listen) => listen(name));
  });
  field.protocol = () => field.input.value;
  chosen.listeners.push((name) => { if (protocols.includes(name)) field.input.value = name; });
  return field;
}

function scenesText(one) {
  const n = one.result ? one.result.scenes.length : 0;
  return [
    n === one.n_planned ? String(n) : `${n}/${one.n_planned}`,
    RUNS[one.run].is_partial ? h('span', { class: 'mark' }, 'PARTIAL') : null,
    n < one.n_planned ? h('span', { class: 'mark' }, 'INCOMPLETE') : null,
  ];
}

function notesOf(rows) {
  const lines = [];
  for (const one of rows) {
    const say = (text) => lines.push(`${nameOf(one)}: ${text}`);
    if (one.caveat) say(one.caveat);
    if (one.failed.length) say(`failed on ${one.failed.join(', ')}`);
    if (one.unscored.length) say(`not scored: ${one.unscored.join(', ')}`);
    (one.result ? one.result.warnings : []).forEach(say);
  }
  const ranked = rows.filter((one) => one.confidences);
  const kinds = [...new Set(ranked.map((one) => one.confidences))];
  if (kinds.length === 1) lines.push(`confidences: ${kinds[0]}`);
  if (kinds.length > 1) {
    const parts = kinds.map((kind) => `${kind} (${ranked.filter((one) => one.confidences === kind).map(nameOf).join(', ')})`);
    lines.unshift(`MIXED CONFIDENCES: ${parts.join('; ')}: average precisions are not comparable`);
  }
  return [...new Set(lines)];
}

function valueCell(metric, value, interval, ceiling) {
  return [
    metricText(metric, value),
    interval ? h('small', null, ` [${metricText(metric, interval[0])}, ${metricText(metric, interval[1])}]`) : null,
    isCount(metric) ? null : whisker(value, interval, ceiling),
  ];
}

// Rows that compete for the best value: methods that use ground truth do not.
const competes = (one) => one.method !== 'oracle' && !(one.caveat || '').includes('a ceiling, not a result');
const onSame = (rows, what) => new Set(rows.filter((one) => competes(one) && one.result).map(what)).size === 1;
const limitOf = (one) => String(RUNS[one.run].limit);
const scenesOf = (one) => [limitOf(one), ...one.result.scenes].join('\n');
function bestOf(rows, value, what = scenesOf) {
  // Rows on different scenes or frames are not compared, and if all are equal none is the best.
  const numbers = rows.filter(competes).map(value).filter(isNumber), most = Math.max(...numbers);
  return numbers.some((one) => one < most) && onSame(rows, what) ? most : null;
}

// Whether the numbers are pooled over all scenes; irrelevant if pooled and mean values agree.
const isPooled = (one) =>
  !!one.result && one.headline.every((metric) => one.result.metrics[metric] === one.result.pooled[metric]);

function summarySection() {
  part('summary', 'Summary', 'In per cent, with the 95 % confidence interval over scenes (unreliable for fewer '
    + 'than ten). The tick on each line is the ground-truth ceiling, which is not a strict upper bound.', (section) => {
    const warn = (...content) => section.append(h('p', { class: 'note warn' }, content));
    for (const [index, run] of RUNS.entries()) {
      const where = RUNS.length > 1 ? `${runNames[index]}: ` : '';
      if (run.is_partial) {
        warn(h('strong', null, `${where}PARTIAL. `), `Only the first ${run.limit} frames of each scene were used.`);
      }
      if (run.is_incomplete) {
        warn(h('strong', null, `${where}INCOMPLETE. `), 'Some scenes failed and are excluded from all numbers.',
          noteList(run.failed, 3));
      }
    }
    for (const one of SWEEPS) {
      section.append(h('p', { class: 'note' }, `${RUNS.length > 1 ? `${runNames[one.run]}: ` : ''}${one.n_cells} methods `
        + 'under corruptions are only in the section ', h('a', { href: '#robustness' }, 'Robustness'), '.'));
    }
    if (DATA.left_out) warn(h('strong', null, 'LARGE. '), `${DATA.left_out}.`);
    for (const protocol of PROTOCOLS) {
      const rows = resultsOf(protocol);
      const below = [noteList(notesOf(rows)), meaningsOf(rows[0].headline)];
      fill(section, null, [h('h3', null, protocol), summaryTable(rows), below]);
    }
    if (!PROTOCOLS.length) warn('These runs have no scores.');
    if (DATA.found.length) fill(section, null, [h('h3', null, 'Predictions without ground truth'), foundTable(DATA.found)]);
    fill(section, null, [noteList(RUNS.flatMap((run) => run.unscored))]);
  });
}

// Descriptions of the metrics, for tooltips and the list below the tables.
const MEANINGS = new Map(Object.entries({
  AP: 'instance average precision, mean over IoU thresholds',
  AP50: 'average precision at an IoU threshold of 0.5',
  AP25: 'average precision at an IoU threshold of 0.25',
  centroid: 'boxes with a correct centre', class: 'boxes with the correct class',
  mIoU: 'point-wise intersection over union, mean over the classes',
  'F-mIoU': 'IoU weighted by the number of points of each class',
  mAcc: 'point-wise recall per class, mean over the classes',
  'label n': 'the label assigned during mapping is correct',
  "label n'": 'the label computed afterwards from the best views of an instance is correct',
  'well-merged': 'instances that match exactly one object', 'under-merged': 'instances that cover only part of an object',
  'over-merged': 'instances that cover several objects',
  "well-merged n'": 'the same, over instances with a label from their best views',
  "under-merged n'": 'the same, over instances with a label from their best views',
  "over-merged n'": 'the same, over instances with a label from their best views',
  answer: 'questions answered correctly', objects: 'questions with the correct objects',
}));

function meaningsOf(metrics) {
  const known = metrics.filter((metric) => MEANINGS.has(metric));
  return !known.length ? null : h('details', null, h('summary', null, 'Column descriptions'),
    h('dl', null, known.flatMap((metric) => [h('dt', null, metric), h('dd', null, MEANINGS.get(metric))])));
}

function foundTable(rows) {
  const named = ([name, n]) => (n === 1 && name ? name : `${name || 'unnamed'} × ${n}`);
  return dataTable({
    caption: 'Contents of the maps; size: longest edge of the bounding box; ms per update: median, including perception',
    rows,
    columns: [
      { label: 'Scene', value: (one) => one.scene },
      { label: 'Method', value: nameOf },
      { label: 'Instances', num: true, value: (one) => one.n_instances, show: (one) => countText(one.n_instances) },
      { label: 'Points', num: true, value: (one) => one.n_points, show: (one) => countText(one.n_points) },
      { label: 'Smallest / median / largest (m)', num: true, value: (one) => (one.extents_m ? one.extents_m[1] : null),
        show: (one) => (one.extents_m ? one.extents_m.map((edge) => edge.toFixed(2)).join(' / ') : '–') },
      { label: 'Updates', num: true, value: (one) => one.n_updates },
      { label: 'ms per update', num: true, value: (one) => one.update_ms, show: (one) => msText(one.update_ms) },
      { label: 'Names', value: (one) => one.names.slice(0, 12).map(named).join(', ') },
    ],
  });
}

function summaryTable(rows) {
  const metrics = rows[0].headline;
  const at = (one, metric) => (one.result ? one.result.metrics[metric] : null);
  const best = Object.fromEntries(metrics.map((metric) => [metric, bestOf(rows, (one) => at(one, metric))]));
  const covered = (one) => {
    const share = one.result && one.result.coverage['0.05'];
    return isNumber(share) ? 1 - share : null;
  };
  const column = (metric) => ({
    label: metric, title: MEANINGS.get(metric), num: true, value: (one) => at(one, metric),
    best: (one) => best[metric] !== null && competes(one) && at(one, metric) === best[metric],
    show: (one) => valueCell(metric, at(one, metric), one.result && one.result.intervals[metric],
      one.ceiling && one.ceiling[metric]),
  });
  const marks = metrics.some((metric) => best[metric] !== null);
  const interval = (metric, end) => ({ label: `${metric} ${end ? 'high' : 'low'}`,
    value: (one) => (one.result && one.result.intervals[metric] ? one.result.intervals[metric][end] : null) });
  const ceilings = (one) => metrics.map((metric) => metricText(metric, one.ceiling[metric])).join(' / ');
  return dataTable({
    caption: `Version ${rows[0].version}, ${isPooled(rows[0]) ? 'all scenes pooled' : 'mean over scenes'}`
      + `${marks ? '; best in bold' : ''}`,
    rows,
    file: `${rows[0].protocol} summary`,
    hidden: metrics.flatMap((metric) => [interval(metric, 0), interval(metric, 1),
      { label: `${metric} ceiling`, value: (one) => one.ceiling && one.ceiling[metric] }]),
    columns: [
      { label: 'Method', value: nameOf },
      ...metrics.map(column),
      { label: 'Ground-truth ceiling', isOnlyShown: true, title: 'Score of the ground truth evaluated as a prediction', num: true,
        value: (one) => (one.ceiling ? one.ceiling[metrics[0]] : null),
        show: (one) => (one.ceiling ? ceilings(one) : '–') },
      { label: 'Scenes', num: true, value: (one) => (one.result ? one.result.scenes.length : 0), show: scenesText },
      { label: 'Coverage (5 cm)', title: 'Fraction of ground-truth points within 5 cm of the map', num: true,
        value: covered, show: (one) => percent(covered(one)) },
    ],
  });
}

// A table of one protocol and metric: one row per scene or class, one column per method.
function matrixSection({ id, title, intro, what, head, metricsOf, valuesOf }) {
  const usable = PROTOCOLS.filter((protocol) =>
    resultsOf(protocol).some((one) => one.result && Object.keys(valuesOf(one)).length));
  if (!usable.length) return;
  part(id, title, intro, (section) => {
    const place = h('div'), protocols = protocolField(usable), metric = select(what, [], null, draw);
    section.append(h('div', { class: 'toolbar' }, protocols, metric), place);
    const scored = () => resultsOf(protocols.protocol()).filter((one) => one.result);
    chosen.listeners.push(refresh);
    function refresh() {
      const names = metricsOf(scored());
      const kept = names.includes(metric.input.value) ? metric.input.value : names[0];
      metric.setOptions(names.map((name) => [name, name]), kept);
      draw();
    }
    function draw() {
      place.replaceChildren(matrixTable(protocols.protocol(), metric.input.value, scored(), head, valuesOf));
    }
    refresh();
  });
}

function matrixTable(protocol, name, all, head, valuesOf) {
  const ofScenes = head === 'Scene';
  const keys = [...new Set(all.flatMap((one) => Object.keys(valuesOf(one))))];
  const at = (one, key) => {
    const values = valuesOf(one)[key];
    return values ? values[name] : null;
  };
  const best = (key) => bestOf(all, (one) => at(one, key), ofScenes ? limitOf : scenesOf);
  const rows = keys.map((key) => ({ key, best: best(key) }))
    .filter((row) => all.some((one) => isNumber(at(one, row.key))));
  const pooled = (one) => one.result.metrics[name];
  const marked = rows.some((row) => row.best !== null) ? '; best per row in bold' : '';
  const partial = all.some((one) => RUNS[one.run].is_partial) ? ' (PARTIAL)' : '';
  return dataTable({
    caption: `${protocol}: ${name} in per cent${partial}${marked}`,
    rows, filter: ofScenes ? 'scenes' : 'classes', tall: rows.length > 14,
    columns: [{ label: head, value: (row) => row.key, show: (row) => toGallery(row.key,
      { protocol, [ofScenes ? 'scene' : 'name']: row.key, metric: name }, `Worst errors of ${row.key}`) }, ...all.map((one) => ({
      label: nameOf(one), num: true, value: (row) => at(one, row.key),
      show: (row) => metricText(name, at(one, row.key)),
      best: (row) => row.best !== null && competes(one) && at(one, row.key) === row.best }))],
    foot: all.some((one) => isNumber(pooled(one)))
      ? h('tfoot', null, h('tr', null, h('th', { scope: 'row' }, 'Overall'),
        all.map((one) => h('td', { class: 'num' }, metricText(name, pooled(one))))))
      : null,
  });
}

function scenesSection() {
  matrixSection({ id: 'scenes', title: 'Scenes', what: 'Metric', head: 'Scene',
    intro: 'Results per scene.',
    metricsOf: (rows) => [...new Set(rows.flatMap((one) => [...one.headline, ...Object.keys(one.result.metrics)]))],
    valuesOf: (one) => (one.result ? one.result.per_scene : {}) });
}

function classesSection() {
  const columnsOf = (one) => Object.values(one.result.per_class).slice(0, 1).flatMap(Object.keys);
  matrixSection({ id: 'classes', title: 'Classes', what: 'Column', head: 'Class',
    intro: 'Results per class over all scenes; classes without a value for any method are omitted.',
    metricsOf: (rows) => [...new Set(rows.flatMap(columnsOf))],
    valuesOf: (one) => (one.result ? one.result.per_class : {}) });
}
