// The sections Compare and Provenance.

function compareSection() {
  if (!DATA.comparisons.length) return;
  part('compare', 'Compare', 'Difference B − A over the common scenes, in percentage points, with the 95 % confidence '
    + 'interval (jackknife t); p of the exact sign-flip test over scenes (assumes symmetric differences), with the '
    + 'smallest possible p for this number of scenes; p adjusted by Holm over all metrics of the comparison. Bold: '
    + 'adjusted p below 0.05.', (section) => {
    const sides = [...new Set(DATA.comparisons.flatMap((one) => [one.left, one.right].map(String)))].map((text) => {
      const at = text.indexOf(',');
      return [text, sideName(Number(text.slice(0, at)), text.slice(at + 1))];
    });
    const first = DATA.comparisons[0], place = h('div', { role: 'status' });
    const a = select('A', sides, String(first.left), draw), b = select('B', sides, String(first.right), draw);
    const turn = () => { [a.input.value, b.input.value] = [b.input.value, a.input.value]; draw(); };
    const swap = h('button', { type: 'button', class: 'plain', onclick: turn }, 'Swap');
    section.append(h('div', { class: 'toolbar' }, a, b, swap), place);
    const find = (left, right) =>
      DATA.comparisons.find((one) => String(one.left) === left && String(one.right) === right);
    function draw() {
      const [left, right] = [a.input.value, b.input.value], straight = find(left, right);
      const one = straight || find(right, left);
      if (one && !one.reason) { place.replaceChildren(...compared(one, !straight)); return; }
      const why = left === right ? 'Choose two different methods.'
        : 'This page has no comparison of these two; run su3d-bench compare.';
      place.replaceChildren(h('p', { class: one ? 'note warn' : 'note' }, one ? one.reason : why));
    }
    draw();
  });
}

// The table of one comparison; `isTurned` if its right side is A.
function compared(one, isTurned) {
  const times = (value) => (isNumber(value) ? (isTurned ? -value : value) : null);
  const intervalOf = (d) => d.interval && (isTurned ? [-d.interval[1], -d.interval[0]] : d.interval);
  const rows = one.protocols.flatMap((p) => Object.entries(p.metrics).map(([metric, d]) => ({
    protocol: p.protocol, metric, n: p.scenes.length,
    left: isTurned ? d.right : d.left, right: isTurned ? d.left : d.right,
    difference: times(d.difference), interval: intervalOf(d), p: d.p, least: d.smallest_p, pairs: d.n_pairs,
    ofAll: d.p_of_all, disagreement: d.disagreement,
    scenes: Object.entries(d.per_scene).map(([scene, value]) => [scene, times(value)]) })));
  const spread = (row) => (row.interval ? h('small', null, ` [${row.interval.map(signed).join(', ')}]`) : null);
  const least = (row) => h('small', null, ` (${plural(row.pairs, 'scene')}, min. ${row.least.toPrecision(2)})`);
  const table = dataTable({ caption: 'Differences, B − A', rows, columns: [
    { label: 'Protocol', value: (row) => row.protocol }, { label: 'Metric', value: (row) => row.metric },
    { label: 'p', num: true, value: (row) => row.p,
      show: (row) => (isNumber(row.p) ? [row.p.toPrecision(2), least(row)] : '–') },
    { label: 'Adjusted p', num: true, value: (row) => row.ofAll,
      show: (row) => (isNumber(row.ofAll) ? row.ofAll.toPrecision(2) : '–') },
    { label: 'A', num: true, value: (row) => row.left, show: (row) => percent(row.left) },
    { label: 'B', num: true, value: (row) => row.right, show: (row) => percent(row.right) },
    { label: 'B − A', num: true, value: (row) => row.difference, show: (row) => [signed(row.difference), spread(row)],
      best: (row) => isNumber(row.ofAll) && row.ofAll < 0.05 },
    { label: 'Per scene', value: (row) => row.n, show: differenceStrip }] });
  const odd = rows.filter((row) => row.disagreement).map((row) => `${row.protocol}, ${row.metric}: ${row.disagreement}`);
  const notes = [...odd, ...one.remarks, ...one.protocols.flatMap((p) => p.remarks)];
  return [table, h('div', null, noteList([...new Set(notes)]))];
}

function differenceStrip(row) {
  const width = 150, most = Math.max(0.02, ...row.scenes.map(([, value]) => Math.abs(value || 0)));
  const x = (v) => width / 2 + (v / most) * (width / 2 - 6), label = ([scene, value]) => `${scene} ${signed(value)}`;
  return svg('svg', { width, height: 20, viewBox: `0 0 ${width} 20`, role: 'img',
    'aria-label': row.scenes.map(label).join(', ') },
  svg('line', { class: 'track', x1: 0, x2: width, y1: 10, y2: 10 }),
  svg('line', { class: 'tick', x1: width / 2, x2: width / 2, y1: 3, y2: 17 }),
  row.scenes.map((one) => svg('circle', { class: 'dot', cx: x(one[1] || 0), cy: 10, r: 3.5, 'fill-opacity': 0.75 },
    svg('title', null, label(one)))));
}

function provenanceSection() {
  part('provenance', 'Provenance', 'Configuration, code version and data of each run.', (section) => {
    RUNS.forEach((run, index) => {
      const lines = factsOfRun(run).flatMap(([name, text]) => [h('dt', null, name), h('dd', null, text)]);
      fill(section, null, [h('h3', null, runNames[index]), h('dl', null, lines), noteList(run.warnings)]);
      section.append(h('details', null, h('summary', null, 'Protocols and data'), protocolsOf(run), dataOf(run)),
        h('details', null, h('summary', null, `Settings (${run.settings.length})`), settingsOf(run)));
    });
  });
}

function factsOfRun(run) {
  const status = run.is_incomplete ? 'incomplete' : 'complete';
  const packages = Object.entries(run.packages).map(([name, version]) => `${name} ${version}`);
  return [
    ['Folder', run.name], ['Status', run.is_partial ? `${status}, partial: ${run.limit} frames per scene` : status],
    ['Methods', run.methods.join(', ')], ['Scenes', String(run.scenes.length)], ['Perception profile', run.profile || '–'],
    ['Encoder', run.encoder ? `${run.encoder}, ${run.encoder_digest || 'no digest'}` : '–'],
    ['Seed', String(run.seed ?? '–')], ['Code', run.code],
    ['Commit', run.git ? `${run.git.commit}${run.git.is_dirty ? ', modified' : ''}` : 'not recorded'],
    ['Hardware', run.hardware], ['Packages', packages.join(', ')],
  ];
}

const hash = (text) => h('span', { class: 'hash' }, text);
function protocolsOf(run) {
  return dataTable({ caption: 'Protocols', rows: run.protocols, columns: [
    { label: 'Protocol', value: (row) => row.name }, { label: 'Version', num: true, value: (row) => row.version },
    { label: 'Digest', value: (row) => row.digest, show: (row) => hash(row.digest) }] });
}
function dataOf(run) {
  return dataTable({ caption: 'Scene data', rows: Object.entries(run.data_digests), columns: [
    { label: 'Scene', value: (row) => row[0] },
    { label: 'Digest', value: (row) => row[1], show: (row) => hash(row[1]) }] });
}
function settingsOf(run) {
  const text = (row) => (typeof row.value === 'string' ? row.value : JSON.stringify(row.value));
  return dataTable({ caption: 'run.toml', rows: run.settings, filter: 'settings', tall: true,
    columns: [{ label: 'Key', value: (row) => row.key }, { label: 'Value', value: text }] });
}
