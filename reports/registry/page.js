// The pages of a registry: all rankings with filters, one method, one scene. DATA is collected by
// su3d_bench/reproducing/registry_site.py.

const DATA = JSON.parse(byId('data').textContent);
const ROOT = DATA.kind === 'index' ? '' : '../';
const main = byId('main');

function section(id, title, ...content) {
  const made = h('section', { class: 'part', id, 'aria-labelledby': `${id}-title` },
    h('h2', { id: `${id}-title` }, title), content);
  main.append(made);
  return made;
}
const toSection = (id, title) => byId('nav').append(h('a', { href: `#${id}` }, title));
const intro = (...content) => h('p', { class: 'intro' }, content);
const link = (page, text) => h('a', { href: ROOT + page }, text);
const links = (entries) => h('ul', { class: 'links' }, entries.map((one) => h('li', null, one)));
const hash = (text) => h('span', { class: 'hash' }, text);
const seconds = (value) => (isNumber(value) ? `${Number(value.toPrecision(2))} s` : '–');
const megabytes = (bytes) => `${(bytes / 1e6).toLocaleString('en-US', { maximumFractionDigits: 1 })} MB`;
const datasetsOf = (board) => board.datasets.join(', ');
const scenesText = (board) => `${plural(board.scenes.length, 'scene')} of ${datasetsOf(board)}`;
// Without the CPU family and model numbers, which are on the method's page.
const shortHardware = (row) => row.hardware.replace(/ \(cpu family[^)]*\)/, '');
const SIZES = COSTS.filter(([key]) => !['frame_s', 'map_s'].includes(key));
const sizeText = (value) => (isNumber(value) ? countText(Number(value.toPrecision(3))) : '–');
const ranksText = (row) => (!row.ranks ? '–'
  : row.ranks[0] === row.ranks[1] ? String(row.ranks[0]) : `${row.ranks[0]} to ${row.ranks[1]}`);

const RANK = { num: true, isOnlyShown: true, value: (row) => (row.ranks ? row.ranks[0] + row.ranks[1] / 1e3 : null),
  show: ranksText, hidden: [0, 1].map((end) => (
    { label: `rank ${end ? 'to' : 'from'}`, value: (row) => (row.ranks ? row.ranks[end] : null) })) };

function bundleText({ bundle }) {
  const name = bundle.address ? h('a', { href: bundle.address, rel: 'noreferrer' }, bundle.file) : bundle.file;
  return [name, ` (${megabytes(bundle.n_bytes)}) SHA-256 `, hash(bundle.sha256)];
}

function valueCell(metric, value, interval) {
  return [metricText(metric, value),
    interval ? h('small', null, ` [${metricText(metric, interval[0])}, ${metricText(metric, interval[1])}]`) : null,
    isCount(metric) ? null : whisker(value, interval)];
}

// The best value among the ranked rows, or null if all are equal.
function bestOf(rows, value) {
  const numbers = rows.filter((row) => !row.is_ceiling).map(value).filter(isNumber), most = Math.max(...numbers);
  return numbers.some((one) => one < most) ? most : null;
}

const pictureOf = (row) => (!row.picture ? null : h('img', { class: 'map', width: 120, height: 90, alt: `Map of ${row.method}`,
  src: `data:image/png;base64,${DATA.pictures[row.picture]}` }));
// Of a sweep over corruptions, in points.
const changesOf = (row) => row.changes.map(([family, change]) => `${family} ${signed(change)}`).join(', ');
const authorsOf = (row) => (row.link
  ? h('a', { href: row.link, rel: 'noreferrer', 'aria-label': `${row.method}: ${row.authors}` }, row.authors) : row.authors);
const words = (label, value, more = {}) => ({ label, value, words: true, ...more });

function headlineColumns(board, valueOf, withIntervals) {
  return board.headline.map((metric, k) => {
    const best = bestOf(board.rows, (row) => valueOf(row, k));
    return { label: metric, num: true, value: (row) => valueOf(row, k),
      best: (row) => best !== null && !row.is_ceiling && valueOf(row, k) === best,
      show: (row) => valueCell(metric, valueOf(row, k), withIntervals ? row.intervals[k] : null) };
  });
}

// A dataTable whose text columns may wrap.
function table(file, caption, columns, rows) {
  const made = dataTable({ file, caption, columns, rows, hidden: columns.flatMap((column) => column.hidden || []) });
  const mark = () => made.querySelectorAll('tbody tr').forEach((line) => columns.forEach((column, k) => {
    if (column.words) line.children[k].classList.add('words');
  }));
  mark();
  made.addEventListener('click', mark);
  return made;
}

function boardTable(board, rows) {
  const metrics = headlineColumns(board, (row, k) => row.values[k], true);
  return table(`${board.protocol} ranking`, `${scenesText(board)}; per cent with the 95 % confidence interval over scenes, best in bold`, [
    { label: 'Method', value: (row) => row.method, show: (row) => [pictureOf(row), link(row.page, row.method)] },
    { ...RANK, label: 'Rank', title: 'Simultaneous 95 % rank interval' },
    ...metrics,
    ...(rows.some((row) => row.changes.length) ? [words('Change under corruptions, points', changesOf)] : []),
    { label: 'Time per frame, as submitted', title: 'Median time per processed frame, not measured again; in brackets without perception', num: true,
      value: (row) => row.costs.frame_s, show: (row) => [seconds(row.costs.frame_s),
        isNumber(row.costs.map_s) ? h('small', null, ` (${seconds(row.costs.map_s)})`) : null] },
    ...SIZES.filter(([key]) => rows.some((row) => isNumber(row.costs[key]))).map(([key, label]) => (
      { label, num: true, value: (row) => row.costs[key], show: (row) => sizeText(row.costs[key]) })),
    words('Authors', (row) => row.authors, { show: authorsOf }),
    { label: 'Date', num: true, value: (row) => row.date || null, show: (row) => row.date || '–' },
    words('Hardware', (row) => shortHardware(row)),
    words('Weights trained on', (row) => row.trained_on),
    { label: 'Perception profile', value: (row) => row.profile },
    words('Command and bundle', (row) => row.bundle.file, { show: (row) => h('details', null,
      h('summary', { 'aria-label': `${row.bundle.file}: command and SHA-256 of ${row.method}` }, row.bundle.file),
      h('code', null, row.command), bundleText(row)) }),
  ], rows);
}

function boardIntro(board) {
  const pages = new Map((DATA.scenes || []).map((one) => [one.name, one.page]));
  return [intro(`Version ${board.version}: ${board.summary}. Protocol digest `, hash(board.digest.slice(0, 16)), '.'),
    pages.size ? h('details', null, h('summary', null, plural(board.scenes.length, 'scene')),
      links(board.scenes.map((scene) => link(pages.get(scene), scene)))) : null];
}

const notes = (lines) => (lines.length ? h('ul', { class: 'notes' }, lines.map((line) => h('li', null, line))) : null);
const facts = (pairs) => h('dl', null, pairs.filter(([, value]) => value).flatMap(([name, value]) =>
  [h('dt', null, name), h('dd', null, value)]));

// --- all rankings

const FILTERS = [
  ['Protocol', (row, board) => board.protocol], ['Dataset', (row, board) => datasetsOf(board)],
  ['Perception profile', (row) => row.profile], ['Hardware', shortHardware],
];

function indexPage() {
  const all = DATA.boards.flatMap((board) => board.rows.map((row) => [row, board]));
  const fact = (n, what) => h('li', null, h('b', null, String(n)), ` ${what}${n === 1 ? '' : 's'}`);
  main.append(h('ul', { class: 'facts' }, fact(all.length, 'row'), fact(DATA.methods.length, 'method'),
    fact(new Set(DATA.boards.map((board) => board.protocol)).size, 'protocol'), fact(DATA.scenes.length, 'scene'),
    fact(DATA.n_bundles, 'bundle')));
  if (!all.length) { main.append(h('p', { class: 'note' }, 'This registry has no entries.')); leftOut(); return; }
  const state = FILTERS.map(() => '');
  let text = '';
  const fields = FILTERS.map(([name, of], k) => {
    const values = [...new Set(all.map(([row, board]) => of(row, board)))].sort(compareValues);
    const field = select(name, [['', 'all'], ...values.map((one) => [one, one])], '', (value) => { state[k] = value; draw(); });
    field.hidden = values.length < 2;
    return field;
  });
  const typed = h('input', { type: 'search', id: freshId('filter'), placeholder: 'any text', autocomplete: 'off',
    oninput: () => { text = typed.value.trim().toLowerCase(); draw(); } });
  const count = h('span', { class: 'count', role: 'status' });
  main.append(h('div', { class: 'toolbar', role: 'search', 'aria-label': 'Filters' }, fields,
    h('div', { class: 'field' }, h('label', { for: typed.id }, 'Filter rows'), typed), count));
  const places = DATA.boards.map((board, k) => {
    const place = h('div');
    const made = section(`board-${k}`, board.protocol, boardIntro(board), place, notes(board.notes));
    made.classList.add('board');
    return { made, place };
  });
  const says = (row, board) => [board.protocol, board.summary, ...board.scenes, row.method, row.hardware, row.trained_on,
    row.profile, row.encoder, row.authors, row.command, row.bundle.file, row.bundle.sha256, row.caveat].join('\n').toLowerCase();
  function draw() {
    let n = 0;
    DATA.boards.forEach((board, k) => {
      const rows = board.rows.filter((row) => FILTERS.every(([, of], j) => !state[j] || of(row, board) === state[j])
        && (!text || says(row, board).includes(text)));
      n += rows.length;
      places[k].made.hidden = !rows.length;
      const costs = rows.flatMap((row) => board.headline.map((metric, j) => (
        { method: row.method, metric, value: row.values[j], machine: row.hardware, ...row.costs })));
      places[k].place.replaceChildren(boardTable(board, rows), costPlots(costs));
    });
    count.textContent = `${n === all.length ? '' : `${n} of `}${plural(all.length, 'row')}`;
  }
  draw();
  section('methods', 'Methods', links(DATA.methods.map((one) =>
    [link(one.page, one.name), ` ${plural(one.n_rows, 'row')}`])));
  section('scenes', 'Scenes', links(DATA.scenes.map((one) => link(one.page, one.name))));
  toSection('methods', 'Methods');
  toSection('scenes', 'Scenes');
  leftOut();
}

function leftOut() {
  if (!DATA.left_out.length) return;
  section('left-out', 'Excluded', intro('Results in the registry that are in no ranking.'),
    notes(DATA.left_out.map((one) => `${one.run}, ${one.what}: ${one.reason}`)));
  toSection('left-out', 'Excluded');
}

// --- one method

function methodPage() {
  main.append(intro(`${DATA.registry}: ${plural(DATA.boards.length, 'ranking')}.`));
  DATA.boards.forEach((board, k) => board.rows.forEach((row) => {
    const id = `board-${k}`;
    const values = board.headline.map((metric, j) => h('li', null, `${metric} `, h('b', null, metricText(metric, row.values[j])),
      row.intervals[j] ? ` [${row.intervals[j].map((end) => metricText(metric, end)).join(', ')}]` : null));
    const rank = row.ranks ? h('li', null, 'rank ', h('b', null, ranksText(row)), ` of ${board.n_ranked}`) : null;
    section(id, board.protocol,
      intro(`Version ${board.version}: ${board.summary}. ${scenesText(board)}.`),
      h('ul', { class: 'facts' }, values, rank), notes([...(row.caveat ? [row.caveat] : []), ...row.warnings]),
      pictureOf(row), facts([
        [`Mean change of ${board.headline[0]} under corruptions, points`, changesOf(row)],
        ['Authors', authorsOf(row)], ['Date', row.date],
        ['Time per frame, as submitted', row.n_updates
          ? `${seconds(row.costs.frame_s)}, ${seconds(row.costs.map_s)} without perception (median of `
            + `${plural(row.n_updates, 'frame')})` : 'not measured'],
        ...SIZES.map(([key, label]) => [label, isNumber(row.costs[key]) ? sizeText(row.costs[key]) : null]),
        ['Hardware', row.hardware], ['Perception profile', row.profile], ['Encoder', row.encoder],
        ['Weights trained on', row.trained_on], ['Settings', row.changed.join(', ')],
        ['Command', h('code', null, row.command)], ['Bundle', bundleText(row)],
        ['Created by', `${row.bundle.program}, code ${row.code}${row.commit ? `, commit ${row.commit}` : ''}`
          + `${row.bundle.recipe ? `, recipe ${row.bundle.recipe}` : ''}, run ${row.run}`],
        ['Protocol digest', hash(board.digest)],
      ]),
      row.weights.some((one) => Object.keys(one.files).length) ? h('details', null, h('summary', null, 'Weight files'),
        facts(row.weights.flatMap((one) => Object.entries(one.files).map(([file, sha]) => [`${one.model} ${file}`, hash(sha)]))))
        : null,
      scenesTable(board, row));
    toSection(id, board.protocol);
  }));
}

function scenesTable(board, row) {
  const rows = Object.entries(row.of_scenes).map(([scene, values]) => ({ scene, values }));
  return table(`${row.method} ${board.protocol} scenes`, 'Per scene, in per cent', [
    { label: 'Scene', value: (one) => one.scene, show: (one) => link(DATA.scene_pages[one.scene], one.scene) },
    ...board.headline.map((metric, k) => ({ label: metric, num: true, value: (one) => one.values[k],
      show: (one) => valueCell(metric, one.values[k]) })),
  ], rows);
}

// --- one scene

function scenePage() {
  main.append(intro('Results on this scene only; rankings use all scenes. Data digest ',
    hash(DATA.digest), '.'));
  DATA.boards.forEach((board, k) => {
    const id = `board-${k}`, valueOf = (row, j) => row.of_scenes[DATA.name][j];
    section(id, board.protocol, intro(`Version ${board.version}: ${board.summary}. Ranked over ${scenesText(board)}.`),
      table(`${DATA.name} ${board.protocol}`, 'This scene, in per cent; best in bold', [
        { label: 'Method', value: (row) => row.method, show: (row) => link(row.page, row.method) },
        ...headlineColumns(board, valueOf, false),
        { ...RANK, label: 'Rank over all scenes' },
        { label: 'Perception profile', value: (row) => row.profile },
        words('Bundle', (row) => row.bundle.file),
      ], board.rows));
    toSection(id, board.protocol);
  });
}

({ index: indexPage, method: methodPage, scene: scenePage })[DATA.kind]();
