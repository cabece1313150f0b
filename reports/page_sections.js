// The sections of numbers. DATA is what su3d_bench/page_sources.py gathers.

const DATA = JSON.parse(byId('data').textContent);
const RUNS = DATA.runs;
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
const PROTOCOLS = [...new Set(DATA.results.map((one) => one.protocol))];
const resultsOf = (protocol) => DATA.results.filter((one) => one.protocol === protocol);
const nameOf = (one) => sideName(one.run, one.method);
const styleOf = (run, method) => SIDES.findIndex((side) => side.run === run && side.method === method);

function part(id, title, intro) {
  const section = h('section', { class: 'part', id, 'aria-labelledby': `${id}-title` },
    h('h2', { id: `${id}-title` }, title), intro ? h('p', { class: 'intro' }, intro) : null);
  byId('nav').append(h('a', { href: `#${id}` }, title));
  byId('main').append(section);
  return section;
}

// One choice of protocol for all sections that show one.
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
  return [n === one.n_planned ? String(n) : `${n}/${one.n_planned}`, RUNS[one.run].is_partial ? h('span', { class: 'mark' }, 'PARTIAL') : null,
    n < one.n_planned ? h('span', { class: 'mark' }, 'INCOMPLETE') : null];
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
  return [...new Set(lines)];
}

function noteList(lines, most = 6) {
  if (!lines.length) return null;
  const list = (some) => h('ul', { class: 'notes' }, some.map((line) => h('li', null, line)));
  return [list(lines.slice(0, most)), lines.length > most
    ? h('details', null, h('summary', null, `${lines.length - most} more remarks`), list(lines.slice(most))) : null];
}

function valueCell(metric, value, interval, ceiling) {
  return [metricText(metric, value), interval
    ? h('small', null, ` [${metricText(metric, interval[0])}, ${metricText(metric, interval[1])}]`) : null,
  isCount(metric) ? null : whisker(value, interval, ceiling)];
}

// Marks the highest of what competes: what was told the truth does not.
const competes = (one) => one.method !== 'oracle' && !(one.caveat || '').includes('a ceiling, not a result');
const onSame = (rows, what) => new Set(rows.filter((one) => competes(one) && one.result).map(what)).size === 1;
const limitOf = (one) => String(RUNS[one.run].limit);
const scenesOf = (one) => [limitOf(one), ...one.result.scenes].join('\n');
function bestOf(rows, value, what = scenesOf) {
  // Rows on other scenes or other frames are not compared.
  const numbers = rows.filter(competes).map(value).filter(isNumber);
  return numbers.length > 1 && onSame(rows, what) ? Math.max(...numbers) : null;
}

// Whether the numbers are those of all scenes together; where the two agree it does not matter.
const isPooled = (one) => !!one.result && one.headline.every((metric) => one.result.metrics[metric] === one.result.pooled[metric]);

function summarySection() {
  const section = part('summary', 'Summary', 'Per cent with the 95 % interval over scenes. The tick on a line is the ceiling: what the truth itself scores. The best is bold where all rows are of the same scenes and frames.');
  for (const [index, run] of RUNS.entries()) {
    const where = RUNS.length > 1 ? `${runNames[index]}: ` : '';
    if (run.is_partial) section.append(h('p', { class: 'note warn' }, h('strong', null, `${where}PARTIAL. `), `Only the first ${run.limit} frames of each scene were used.`));
    if (run.is_incomplete) section.append(h('p', { class: 'note warn' }, h('strong', null, `${where}INCOMPLETE. `), 'Some scenes failed and are in no number.', noteList(run.failed, 3)));
  }
  for (const protocol of PROTOCOLS) {
    const rows = resultsOf(protocol), metrics = rows[0].headline;
    const at = (one, metric) => (one.result ? one.result.metrics[metric] : null);
    const best = Object.fromEntries(metrics.map((metric) => [metric, bestOf(rows, (one) => at(one, metric))]));
    const covered = (one) => { const share = one.result && one.result.coverage['0.05']; return isNumber(share) ? 1 - share : null; };
    fill(section, null, [h('h3', null, protocol), dataTable({
      caption: `Version ${rows[0].version}, ${isPooled(rows[0]) ? 'all scenes pooled' : 'mean of the scenes'}`, rows,
      columns: [
        { label: 'Method', value: nameOf },
        ...metrics.map((metric) => ({ label: metric, num: true, value: (one) => at(one, metric),
          best: (one) => best[metric] !== null && competes(one) && at(one, metric) === best[metric],
          show: (one) => valueCell(metric, at(one, metric), one.result && one.result.intervals[metric], one.ceiling && one.ceiling[metric]) })),
        { label: 'Ceiling', num: true, value: (one) => (one.ceiling ? one.ceiling[metrics[0]] : null),
          show: (one) => (one.ceiling ? metrics.map((metric) => metricText(metric, one.ceiling[metric])).join(' / ') : '–') },
        { label: 'Scenes', num: true, value: (one) => (one.result ? one.result.scenes.length : 0), show: scenesText },
        { label: 'Within 5 cm', num: true, value: covered, show: (one) => percent(covered(one)) },
      ],
    }), noteList(notesOf(rows))]);
  }
  if (!PROTOCOLS.length) section.append(h('p', { class: 'note warn' }, 'No protocol scored these runs.'));
}

// A table with a row a scene or class and a column a method, of one protocol and one metric.
function matrixSection({ id, title, intro, what, head, metricsOf, valuesOf, extra }) {
  const usable = PROTOCOLS.filter((protocol) => resultsOf(protocol).some((one) => one.result && Object.keys(valuesOf(one)).length));
  if (!usable.length) return;
  const section = part(id, title, intro), place = h('div');
  const protocols = protocolField(usable), metric = select(what, [], null, draw);
  section.append(h('div', { class: 'toolbar' }, protocols, metric), place);
  chosen.listeners.push(refresh);
  function refresh() {
    const rows = resultsOf(protocols.protocol()).filter((one) => one.result);
    const names = metricsOf(rows);
    metric.setOptions(names.map((name) => [name, name]), names.includes(metric.input.value) ? metric.input.value : names[0]);
    draw();
  }
  function draw() {
    const all = resultsOf(protocols.protocol()).filter((one) => one.result), name = metric.input.value;
    const keys = [...new Set(all.flatMap((one) => Object.keys(valuesOf(one))))];
    const at = (one, key) => { const values = valuesOf(one)[key]; return values ? values[name] : null; };
    const rows = keys.map((key) => ({ key, best: bestOf(all, (one) => at(one, key), head === 'Scene' ? limitOf : scenesOf) }))
      .filter((row) => all.some((one) => isNumber(at(one, row.key))));
    const pooled = (one) => one.result.metrics[name];
    place.replaceChildren(dataTable({
      caption: `${protocols.protocol()}: ${name} in per cent${all.some((one) => RUNS[one.run].is_partial) ? ' (PARTIAL)' : ''}`,
      rows, filter: head === 'Scene' ? 'scenes' : 'classes', tall: rows.length > 14,
      columns: [{ label: head, value: (row) => row.key }, ...(extra ? extra(all, name) : []), ...all.map((one) => ({
        label: nameOf(one), num: true, value: (row) => at(one, row.key), show: (row) => metricText(name, at(one, row.key)),
        best: (row) => row.best !== null && competes(one) && at(one, row.key) === row.best }))],
      foot: all.some((one) => isNumber(pooled(one))) ? h('tfoot', null, h('tr', null, h('th', { scope: 'row' }, 'As reported'),
        all.map((one) => h('td', { class: 'num' }, metricText(name, pooled(one)))))) : null,
    }));
  }
  refresh();
}

function scenesSection() {
  matrixSection({ id: 'scenes', title: 'Scenes', what: 'Metric', head: 'Scene',
    intro: 'Each scene alone. The best of a row is bold where all methods saw the same frames.',
    metricsOf: (rows) => [...new Set(rows.flatMap((one) => [...one.headline, ...Object.keys(one.result.metrics)]))],
    valuesOf: (one) => (one.result ? one.result.per_scene : {}) });
}

function classesSection() {
  matrixSection({ id: 'classes', title: 'Classes', what: 'Column', head: 'Class',
    intro: 'Each class over all scenes; classes without a value in any method are left out.',
    metricsOf: (rows) => [...new Set(rows.flatMap((one) => Object.values(one.result.per_class).slice(0, 1).flatMap(Object.keys)))],
    valuesOf: (one) => (one.result ? one.result.per_class : {}) });
}

function confusionSection() {
  const usable = DATA.confusions;
  if (!usable.length) return;
  const section = part('confusion', 'Confusion', 'Rows are the true class, columns what the map calls its points, as shares of the row. The classes with most points come first.');
  const names = [...new Set(usable.map((one) => one.protocol))], place = h('div'), most = 18;
  const protocols = protocolField(names), side = select('Method', [], null, draw);
  section.append(h('div', { class: 'toolbar' }, protocols, side), place);
  chosen.listeners.push(refresh);
  function refresh() {
    const fitting = usable.map((one, k) => [k, one]).filter(([, one]) => one.protocol === protocols.protocol());
    side.setOptions(fitting.map(([k, one]) => [k, nameOf(one)]), side.input.value);
    draw();
  }
  function draw() {
    const one = usable[side.input.value];
    if (!one) return;
    if (one.reason) { place.replaceChildren(h('p', { class: 'note' }, one.reason)); return; }
    const total = new Map(), cells = new Map();
    for (const [truth, called, n] of one.cells) {
      total.set(truth, (total.get(truth) || 0) + n);
      cells.set(`${truth},${called}`, n);
    }
    const shown = [...total.keys()].sort((a, b) => total.get(b) - total.get(a) || a - b).slice(0, most);
    const columns = [...shown, -1], label = (k) => (k < 0 ? 'none' : one.names[k]);
    const share = (truth, called) => (cells.get(`${truth},${called}`) || 0) / total.get(truth);
    const table = h('table', { class: 'confusion' },
      h('caption', null, `${nameOf(one)}, ${one.protocol}: the ${shown.length} largest of ${total.size} true classes`),
      h('thead', null, h('tr', null, h('td'), columns.map((k) => h('th', { scope: 'col' }, h('span', null, label(k)))))),
      h('tbody', null, shown.map((truth) => h('tr', null, h('th', { scope: 'row' }, label(truth)), columns.map((called) => {
        const value = share(truth, called);
        const cell = h('td', { class: truth === called ? 'same' : null,
          title: `${label(truth)} called ${label(called)}: ${percent(value)} %, ${countText(cells.get(`${truth},${called}`) || 0)} points` },
        value >= 0.005 ? (100 * value).toFixed(0) : '');
        if (value > 0) cell.style.backgroundColor = `rgba(var(--heat), ${(0.06 + 0.84 * value).toFixed(3)})`;
        if (value > 0.6) cell.style.color = 'var(--on-accent)';
        return cell;
      })))));
    const wrong = one.cells.filter(([truth, called]) => truth !== called)
      .map(([truth, called, n]) => ({ truth: label(truth), called: label(called), n, share: n / total.get(truth) }))
      .sort((a, b) => b.n - a.n).slice(0, 200);
    place.replaceChildren(h('div', { class: 'wide', tabindex: '0', role: 'region', 'aria-label': 'Confusion matrix' }, table),
      h('h3', null, 'Largest confusions'), dataTable({ caption: 'True class, what it is called instead, and how many points', rows: wrong, filter: 'classes', tall: wrong.length > 10,
        columns: [{ label: 'True class', value: (row) => row.truth }, { label: 'Called', value: (row) => row.called },
          { label: 'Points', num: true, value: (row) => row.n, show: (row) => countText(row.n) },
          { label: 'Of the class', num: true, value: (row) => row.share, show: (row) => `${percent(row.share)} %` }] }));
  }
  refresh();
}

const CAUSES = {
  instance: { merged: 'one mask holds several objects', split: 'one object lies in several masks', duplicate: 'a mask repeats another one’s object',
    mislabelled: 'the right mask, another class', background: 'a mask that belongs to no object', missed: 'an object that no mask is of' },
  semantic: { geometry: 'no point of the map within 5 cm', background: 'the map is there, but no mask',
    association: 'a mask that belongs to another object', label: 'the object’s own mask, another class' },
};

function errorsSection() {
  if (!DATA.errors.length) return;
  const names = [...new Set(DATA.errors.flatMap((one) => one.protocols.map((p) => p.protocol)))];
  const section = part('errors', 'Errors', 'What each kind of error costs: the gain in points of a per cent when it alone is mended and everything is scored anew. The value, all gains, overlap and rest give 100.');
  const reasons = DATA.errors.filter((one) => one.reason).map((one) => `${nameOf(one)}: not explained: ${one.reason}`);
  if (!names.length) { fill(section, null, [noteList(reasons)]); return; }
  const place = h('div'), protocols = protocolField(names), metric = select('Metric', [], null, draw);
  section.append(h('div', { class: 'toolbar' }, protocols, metric), place);
  fill(section, null, [noteList(reasons)]);
  chosen.listeners.push(refresh);
  const explained = () => DATA.errors.flatMap((one) => one.protocols.filter((p) => p.protocol === protocols.protocol()).map((p) => ({ ...p, run: one.run, method: one.method })));
  function refresh() {
    const all = explained();
    if (!all.length) return;
    metric.setOptions(Object.keys(all[0].values).map((name) => [name, name]), metric.input.value);
    draw();
  }
  function draw() {
    const all = explained(), name = metric.input.value, kind = all[0].kind;
    const most = Math.max(1e-9, ...all.flatMap((one) => Object.values(one.causes).map((cause) => Math.abs(cause.gains[name] || 0))));
    const bar = (value) => { const made = h('span', { class: value < 0 ? 'bar loss' : 'bar' }); made.style.width = `${((Math.abs(value || 0) / most) * 4.5).toFixed(2)}rem`; return h('span', { class: 'barbox', 'aria-hidden': 'true' }, made); };
    const amount = (one, n) => (one.n_scored === null ? plural(n, 'error') : `${((100 * n) / Math.max(1, one.n_scored)).toFixed(1)} % of points`);
    const row = (title, about, cell) => h('tr', null, h('th', { scope: 'row' }, title, about ? [h('br'), h('small', null, about)] : null), all.map((one) => h('td', { class: 'num' }, cell(one))));
    const stages = [...new Set(all.flatMap((one) => Object.keys(one.stages)))];
    place.replaceChildren(h('div', { class: 'wide', tabindex: '0', role: 'region', 'aria-label': 'What errors cost' }, h('table', null,
      h('caption', null, `${protocols.protocol()}: ${name}, in per cent`),
      h('thead', null, h('tr', null, h('th', { scope: 'col' }, 'Kind of error'), all.map((one) => h('th', { scope: 'col', class: 'num' }, nameOf(one))))),
      h('tbody', null, row('As it is', null, (one) => percent(one.values[name])),
        Object.keys(all[0].causes).map((cause) => row(cause, (CAUSES[kind] || {})[cause], (one) => {
          const { gains, n } = one.causes[cause];
          return [signed(gains[name]), bar(gains[name]), h('br'), h('small', null, amount(one, n))];
        })),
        row('Overlap', 'all mendings together beyond their sum', (one) => signed(one.overlap[name])),
        row('Rest', 'what no mending reaches', (one) => signed(one.rest[name])),
        stages.map((stage) => row(`With true ${stage}`, 'one stage replaced by the truth', (one) => (one.stages[stage] ? percent(one.stages[stage][name]) : '–')))))),
    h('div', null, noteList([...new Set(DATA.errors.flatMap((one) => one.remarks))])));
  }
  refresh();
}

function timingSection() {
  if (!DATA.timing.length) return;
  const section = part('timing', 'Timing', 'What each update costs. Perception is read from its cache where the stage “cache” stands; “map” is everything but reading the frame and perception.');
  section.append(h('ul', { class: 'facts' }, RUNS.map((run, k) => h('li', null, RUNS.length > 1 ? `${runNames[k]}: ` : '', h('b', null, run.hardware)))));
  const scenes = [...new Set(DATA.timing.flatMap((one) => Object.keys(one.series)))];
  const scene = select('Scene', scenes.map((name) => [name, name]), scenes[0], plot);
  const what = select('Time of', [['map', 'the map alone'], ['total', 'the whole update']], 'map', plot);
  const against = select('Against', [['updates', 'updates so far'], ['points', 'points of the map']], 'updates', plot);
  const place = h('div'), below = h('div');
  section.append(h('div', { class: 'toolbar' }, scene, what, against), place);
  function plot() {
    const usable = DATA.timing.filter((one) => one.series[scene.input.value]);
    const lines = usable.map((one) => {
      const series = one.series[scene.input.value];
      const x = against.input.value === 'points' ? series.points || [] : series.total.map((_, k) => Math.min(series.n, (k + 1) * series.per));
      return { name: nameOf(one), style: styleOf(one.run, one.method), x, y: x.length ? series[what.input.value] : [] };
    }).filter((line) => line.x.length);
    const per = Math.max(1, ...usable.map((one) => one.series[scene.input.value].per));
    place.replaceChildren(linePlot({ label: `Milliseconds an update in ${scene.input.value}`, lines, xFromZero: true,
      xLabel: against.input.value === 'points' ? 'points of the map' : 'updates so far', yLabel: `ms an update${per > 1 ? ` (means of up to ${per})` : ''}` }));
  }
  plot();
  const stage = (one, name) => one.stages.find((each) => each.name === name) || {};
  const mib = (bytes) => (isNumber(bytes) ? (bytes / 2 ** 20).toFixed(0) : '–');
  const growth = (g) => (g ? `${g.exponent.toFixed(2)} [${g.low.toFixed(2)}, ${g.high.toFixed(2)}]` : '–');
  section.append(h('h3', null, 'Methods'), dataTable({ caption: 'All scenes; milliseconds an update, the first three of a scene apart', rows: DATA.timing, columns: [
    { label: 'Method', value: nameOf }, { label: 'Updates', num: true, value: (one) => one.n_updates },
    ...[['p50', 'p50'], ['p95', 'p95'], ['max', 'max'], ['first', 'first']].map(([label, key]) => ({ label, num: true, value: (one) => stage(one, 'total')[key], show: (one) => msText(stage(one, 'total')[key]) })),
    { label: 'map p50', num: true, value: (one) => stage(one, 'map').p50, show: (one) => msText(stage(one, 'map').p50) },
    { label: 'With a larger map', value: (one) => (stage(one, 'map').by_points || stage(one, 'map').by_updates || { words: 'too few updates to tell' }).words },
    { label: 'Finish', num: true, value: (one) => one.finish_ms, show: (one) => msText(one.finish_ms) },
    { label: 'Points', num: true, value: (one) => one.n_points, show: (one) => countText(one.n_points) },
    { label: 'Map MiB', num: true, value: (one) => one.map_bytes, show: (one) => mib(one.map_bytes) },
    { label: 'Peak MiB', num: true, value: (one) => one.peak_rss_bytes, show: (one) => mib(one.peak_rss_bytes) },
    { label: 'GPU MiB', num: true, value: (one) => one.device_bytes, show: (one) => mib(one.device_bytes) }] }));
  const side = select('Stages of', DATA.timing.map((one, k) => [k, nameOf(one)]), 0, stages);
  section.append(h('div', { class: 'toolbar' }, side), below);
  function stages() {
    const one = DATA.timing[side.input.value];
    below.replaceChildren(dataTable({ caption: `${nameOf(one)}: milliseconds an update, stage by stage`, rows: one.stages, columns: [
      { label: 'Stage', value: (row) => row.name },
      ...['p50', 'p95', 'max', 'first'].map((key) => ({ label: key, num: true, value: (row) => row[key], show: (row) => msText(row[key]) })),
      { label: 'Share', num: true, value: (row) => row.share, show: (row) => `${percent(row.share)} %` },
      { label: 'Exponent by map points', num: true, value: (row) => row.by_points && row.by_points.exponent, show: (row) => growth(row.by_points) },
      { label: 'Exponent by updates', num: true, value: (row) => row.by_updates && row.by_updates.exponent, show: (row) => growth(row.by_updates) },
      { label: 'With a larger map', value: (row) => (row.by_points || row.by_updates || { words: 'too few updates to tell' }).words }] }));
  }
  stages();
  anytime(section);
}

function anytime(section) {
  const midway = DATA.results.filter((one) => one.anytime.length && one.result);
  if (!midway.length) return;
  const place = h('div'), names = [...new Set(midway.map((one) => one.protocol))];
  const protocols = protocolField(names), metric = select('Metric', [], null, draw);
  section.append(h('h3', null, 'Maps midway'), h('div', { class: 'toolbar' }, protocols, metric), place);
  chosen.listeners.push(refresh);
  function refresh() {
    const first = midway.find((one) => one.protocol === protocols.protocol());
    if (!first) return;
    metric.setOptions(first.headline.map((name) => [name, name]), metric.input.value);
    draw();
  }
  function draw() {
    const name = metric.input.value;
    const lines = midway.filter((one) => one.protocol === protocols.protocol()).map((one) => {
      const points = [...one.anytime.map((each) => [each.share, each.metrics[name]]), [1, one.result.metrics[name]]].filter(([, value]) => isNumber(value)).sort((a, b) => a[0] - b[0]);
      return { name: nameOf(one), style: styleOf(one.run, one.method), x: points.map(([share]) => 100 * share), y: points.map(([, value]) => (isCount(name) ? value : 100 * value)) };
    });
    place.replaceChildren(linePlot({ label: `${name} of maps midway`, lines, xFromZero: true, xLabel: 'per cent of the frames', yLabel: `${name} in per cent` }));
  }
  refresh();
}

function compareSection() {
  if (!DATA.comparisons.length) return;
  const section = part('compare', 'Compare', 'B less A over the scenes that both have, in points of a per cent: with the 95 % interval when both draw the same scenes, and the exact test that flips the signs of single scenes, with the least p that so many scenes can give. Bold: p below 0.05.');
  const sides = [...new Set(DATA.comparisons.flatMap((one) => [one.left, one.right].map(String)))].map((text) => {
    const at = text.indexOf(',');
    return [text, sideName(Number(text.slice(0, at)), text.slice(at + 1))];
  });
  const place = h('div', { role: 'status' });
  const first = DATA.comparisons[0];
  const a = select('A', sides, String(first.left), draw), b = select('B', sides, String(first.right), draw);
  const swap = h('button', { type: 'button', class: 'plain', onclick: () => { [a.input.value, b.input.value] = [b.input.value, a.input.value]; draw(); } }, 'Swap');
  section.append(h('div', { class: 'toolbar' }, a, b, swap), place);
  function draw() {
    const find = (left, right) => DATA.comparisons.find((one) => String(one.left) === left && String(one.right) === right);
    const straight = find(a.input.value, b.input.value), turned = find(b.input.value, a.input.value), one = straight || turned;
    if (!one) { place.replaceChildren(h('p', { class: 'note' }, a.input.value === b.input.value ? 'Choose two different sides.' : 'These two are not compared on this page; run su3d-bench compare.')); return; }
    if (one.reason) { place.replaceChildren(h('p', { class: 'note warn' }, one.reason)); return; }
    const sign = straight ? 1 : -1, times = (value) => (isNumber(value) ? sign * value : null);
    const rows = one.protocols.flatMap((p) => Object.entries(p.metrics).map(([metric, d]) => ({ protocol: p.protocol, metric, n: p.scenes.length,
      left: straight ? d.left : d.right, right: straight ? d.right : d.left, difference: times(d.difference),
      interval: d.interval && (straight ? d.interval : [-d.interval[1], -d.interval[0]]), p: d.p, least: d.smallest_p, pairs: d.n_pairs,
      scenes: Object.entries(d.per_scene).map(([scene, value]) => [scene, times(value)]) })));
    place.replaceChildren(dataTable({ caption: 'Differences, B less A', rows, columns: [
      { label: 'Protocol', value: (row) => row.protocol }, { label: 'Metric', value: (row) => row.metric },
      { label: 'A', num: true, value: (row) => row.left, show: (row) => percent(row.left) }, { label: 'B', num: true, value: (row) => row.right, show: (row) => percent(row.right) },
      { label: 'B − A', num: true, value: (row) => row.difference, show: (row) => [signed(row.difference), row.interval ? h('small', null, ` [${signed(row.interval[0])}, ${signed(row.interval[1])}]`) : null],
        best: (row) => isNumber(row.p) && row.p < 0.05 },
      { label: 'p', num: true, value: (row) => row.p, show: (row) => (isNumber(row.p) ? [row.p.toPrecision(2), h('small', null, ` (${plural(row.pairs, 'scene')}, at least ${row.least.toPrecision(2)})`)] : '–') },
      { label: 'Scene by scene', value: (row) => row.n, show: strip }] }), h('div', null, noteList([...new Set([...one.remarks, ...one.protocols.flatMap((p) => p.remarks)])])));
  }
  function strip(row) {
    const width = 150, most = Math.max(0.02, ...row.scenes.map(([, value]) => Math.abs(value || 0))), x = (v) => width / 2 + (v / most) * (width / 2 - 6);
    return svg('svg', { width, height: 20, viewBox: `0 0 ${width} 20`, role: 'img', 'aria-label': row.scenes.map(([scene, value]) => `${scene} ${signed(value)}`).join(', ') },
      svg('line', { class: 'track', x1: 0, x2: width, y1: 10, y2: 10 }), svg('line', { class: 'tick', x1: width / 2, x2: width / 2, y1: 3, y2: 17 }),
      row.scenes.map(([scene, value]) => svg('circle', { class: 'dot', cx: x(value || 0), cy: 10, r: 3.5, 'fill-opacity': 0.75 }, svg('title', null, `${scene} ${signed(value)}`))));
  }
  draw();
}

function provenanceSection() {
  const section = part('provenance', 'Provenance', 'What these numbers depend on.');
  RUNS.forEach((run, index) => {
    const facts = [['Folder', run.name], ['Status', [run.is_incomplete ? 'incomplete' : 'complete', run.is_partial ? `, partial: ${run.limit} frames a scene` : ''].join('')],
      ['Methods', run.methods.join(', ')], ['Scenes', String(run.scenes.length)], ['Profile', run.profile || '–'],
      ['Encoder', run.encoder ? `${run.encoder}, ${run.encoder_digest || 'no digest'}` : '–'], ['Seed', String(run.seed ?? '–')],
      ['Code', run.code], ['Commit', run.git ? `${run.git.commit}${run.git.is_dirty ? ', with changes' : ''}` : 'not recorded'],
      ['Hardware', run.hardware], ['Packages', Object.entries(run.packages).map(([name, version]) => `${name} ${version}`).join(', ')]];
    section.append(h('h3', null, runNames[index]), h('dl', null, facts.flatMap(([name, text]) => [h('dt', null, name), h('dd', null, text)])));
    fill(section, null, [noteList(run.warnings)]);
    const hash = (text) => h('span', { class: 'hash' }, text);
    section.append(h('details', null, h('summary', null, 'Rules and data'),
      dataTable({ caption: 'Protocols', rows: run.protocols, columns: [{ label: 'Protocol', value: (row) => row.name }, { label: 'Version', num: true, value: (row) => row.version }, { label: 'Digest', value: (row) => row.digest, show: (row) => hash(row.digest) }] }),
      dataTable({ caption: 'Data of the scenes', rows: Object.entries(run.data_digests), columns: [{ label: 'Scene', value: (row) => row[0] }, { label: 'Digest', value: (row) => row[1], show: (row) => hash(row[1]) }] })),
    h('details', null, h('summary', null, `Settings (${run.settings.length})`), dataTable({ caption: 'run.toml', rows: run.settings, filter: 'settings', tall: true,
      columns: [{ label: 'Key', value: (row) => row.key }, { label: 'Value', value: (row) => (typeof row.value === 'string' ? row.value : JSON.stringify(row.value)) }] })));
  });
}
