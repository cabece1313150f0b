// Elements of the page. Text is only inserted as text nodes.

const SVG = 'http://www.w3.org/2000/svg';
const byId = (id) => document.getElementById(id);

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes || {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith('on')) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value === true ? '' : value);
  }
  node.append(...children.flat(Infinity).filter((one) => one !== null && one !== undefined));
  return node;
}

const h = (tag, attributes, ...children) => fill(document.createElement(tag), attributes, children);
const svg = (tag, attributes, ...children) => fill(document.createElementNS(SVG, tag), attributes, children);

let nextId = 0;
const freshId = (stem) => `${stem}-${++nextId}`;

function select(label, options, chosen, onChange) {
  // Options are pairs of value and text; returns the field with `.input`.
  const input = h('select', { id: freshId('select'), onchange: () => onChange(input.value) });
  const field = h('div', { class: 'field' }, h('label', { for: input.id }, label), input);
  field.input = input;
  field.setOptions = (pairs, value) => {
    input.replaceChildren(...pairs.map(([key, text]) => h('option', { value: key }, text)));
    if (pairs.some(([key]) => String(key) === String(value))) input.value = value;
  };
  field.setOptions(options, chosen);
  return field;
}

const isNumber = (value) => typeof value === 'number' && Number.isFinite(value);
// The name distinguishes counts from ratios, as in metrics.json.
const isCount = (metric) => metric.startsWith('n_');
const percent = (value, digits = 1) => (isNumber(value) ? (100 * value).toFixed(digits) : '–');
const metricText = (metric, value) =>
  isNumber(value) && isCount(metric) ? String(Math.round(value)) : percent(value);
const signed = (value) => (isNumber(value) ? (value >= 0 ? '+' : '−') + Math.abs(100 * value).toFixed(1) : '–');
function msText(value) {
  if (!isNumber(value)) return '–';
  return value >= 100 ? value.toFixed(0) : value.toPrecision(3).replace(/\.?0+$/, '');
}
const countText = (value) => (isNumber(value) ? value.toLocaleString('en-US') : '–');
const plural = (n, what) => `${n} ${what}${n === 1 ? '' : 's'}`;

function compareValues(a, b) {
  const missing = (value) => value === null || value === undefined || Number.isNaN(value);
  if (missing(a) || missing(b)) return missing(a) - missing(b);
  if (typeof a === 'number' && typeof b === 'number') return a - b;
  return String(a).localeCompare(String(b), 'en', { numeric: true });
}

// Downloads are data URLs made on a click, so that they work from a disk and do not enlarge the page.
const fileName = (text, suffix) =>
  `${text.toLowerCase().replace(/[^a-z0-9]+/g, '-').replace(/^-|-$/g, '').slice(0, 60) || 'su3d-bench'}.${suffix}`;
function save(name, url) {
  h('a', { href: url, download: name }).click();
}
function downloadButton(what, title, make) {
  return h('p', { class: 'get' }, h('button', { type: 'button', class: 'download', 'aria-label': `Download ${what}: ${title}`,
    onclick: make }, `Download ${what}`));
}
function csvButton(title, lines) {
  // A leading apostrophe keeps spreadsheets from running a text as a formula.
  const cell = (value) => (isNumber(value) ? String(value)
    : `"${String(value ?? '').replace(/^(?=[=+\-@\t\r])/, "'").replaceAll('"', '""')}"`);
  return downloadButton('CSV', title, () => {
    const text = lines().map((line) => line.map(cell).join(',')).join('\r\n');
    save(fileName(title, 'csv'), `data:text/csv;charset=utf-8,${encodeURIComponent(`\ufeff${text}\r\n`)}`);
  });
}

// A box that scrolls sideways, with a line above it where it does.
const overflowing = new ResizeObserver((entries) => {
  for (const box of new Set(entries.map((one) => one.target.closest('.wide')))) {
    if (box?.isConnected) box.previousElementSibling.hidden = box.scrollWidth <= box.clientWidth + 1;
  }
});
function scrollBox(label, node, classes = 'wide') {
  const box = h('div', { class: classes, tabindex: '0', role: 'region', 'aria-label': label }, node);
  overflowing.observe(box);
  overflowing.observe(node);
  return [h('p', { class: 'scrolls', hidden: true }, '↔ Scroll sideways to see all of it'), box];
}

// Stays in place when the table scrolls horizontally.
const captionOf = (text) => h('caption', null, h('span', null, text));

// A sortable table; with `filter`, a search field filters its rows. Columns: {label, title, value(row), show(row), num,
// best}; with `onRow`, rows can be selected by mouse and keyboard. At most `most` of the matching rows are shown. The
// download `file` has all rows, numbers in full precision (ratios as fractions), and `hidden` columns.
function dataTable({
  caption, columns, rows, filter, tall, sortBy, descending, onRow, foot, file = caption, hidden = [], most = Infinity,
}) {
  const state = { column: sortBy === undefined ? null : sortBy, down: !!descending, text: '' };
  const body = h('tbody');
  const headers = columns.map((column, index) =>
    h('th', { scope: 'col', class: column.num ? 'num' : null },
      h('button', { type: 'button', class: 'sort', title: column.title, onclick: () => sort(index) }, column.label)));
  const head = h('thead', null, h('tr', null, headers));
  const node = h('table', null, captionOf(caption), head, body, foot || null);
  const counter = h('span', { class: 'count', role: 'status' });
  const box = h('div', null);
  if (filter) {
    const input = h('input', { type: 'search', id: freshId('filter'), placeholder: 'any text', autocomplete: 'off',
      oninput: () => { state.text = input.value.trim().toLowerCase(); draw(); } });
    box.append(h('div', { class: 'toolbar' },
      h('div', { class: 'field' }, h('label', { for: input.id }, `Filter ${filter}`), input), counter));
  }
  const all = [...columns.filter((column) => !column.isOnlyShown), ...hidden];
  box.append(...scrollBox(caption, node, tall ? 'wide tall' : 'wide'), csvButton(file,
    () => [all.map((column) => column.label), ...rows.map((row) => all.map((column) => column.value(row)))]));

  function sort(index) {
    state.down = state.column === index ? !state.down : !!columns[index].num;
    state.column = index;
    draw();
  }
  function draw() {
    headers.forEach((header, index) => {
      if (index === state.column) header.setAttribute('aria-sort', state.down ? 'descending' : 'ascending');
      else header.removeAttribute('aria-sort');
    });
    let shown = rows.filter((row) => !state.text || columns.some((column) =>
      String(column.value(row) ?? '').toLowerCase().includes(state.text)));
    if (state.column !== null) {
      const value = columns[state.column].value;
      const missing = (row) => { const v = value(row); return v === null || v === undefined || Number.isNaN(v); };
      const order = (a, b) => (state.down ? -1 : 1) * compareValues(value(a), value(b));
      shown = [...shown].sort((a, b) => (missing(a) - missing(b)) || order(a, b));
    }
    const cut = shown.length > most ? `, first ${most} shown` : '';
    counter.textContent = `${shown.length === rows.length ? '' : `${shown.length} of `}${plural(rows.length, 'row')}${cut}`;
    body.replaceChildren(...shown.slice(0, most).map(line));
  }
  function line(row) {
    const cells = columns.map((column, index) => {
      const content = column.show ? column.show(row) : String(column.value(row) ?? '–');
      const classes = [column.num ? 'num' : '', column.best && column.best(row) ? 'best' : ''].join(' ').trim();
      return h(index ? 'td' : 'th', { class: classes || null, scope: index ? null : 'row' }, content);
    });
    const onkeydown = (event) => {
      if (event.key !== 'Enter' && event.key !== ' ') return;
      event.preventDefault();
      onRow(row);
    };
    const attributes = onRow
      ? { tabindex: '0', 'aria-selected': String(!!row.selected), onclick: () => onRow(row), onkeydown } : null;
    const made = h('tr', attributes, cells);
    row.node = made;
    return made;
  }
  draw();
  box.redraw = draw;
  return box;
}

function noteList(lines, most = 6) {
  if (!lines.length) return null;
  const list = (some) => h('ul', { class: 'notes' }, some.map((line) => h('li', null, line)));
  return [
    list(lines.slice(0, most)),
    lines.length > most
      ? h('details', null, h('summary', null, `${lines.length - most} more notes`), list(lines.slice(most)))
      : null,
  ];
}

function whisker(value, interval, ceiling) {
  // 0 to 100 %: a dot at the value, a line for its confidence interval, a tick at the ground-truth ceiling.
  const width = 104, x = (v) => 2 + Math.min(1, Math.max(0, v)) * (width - 4);
  if (!isNumber(value)) return null;
  return svg('svg', { width, height: 10, viewBox: `0 0 ${width} 10`, 'aria-hidden': 'true' },
    svg('line', { class: 'track', x1: 2, x2: width - 2, y1: 5, y2: 5 }),
    interval ? svg('line', { class: 'whisker', x1: x(interval[0]), x2: x(interval[1]), y1: 5, y2: 5 }) : null,
    isNumber(ceiling) ? svg('line', { class: 'tick', x1: x(ceiling), x2: x(ceiling), y1: 1, y2: 9 }) : null,
    svg('circle', { class: 'dot', cx: x(value), cy: 5, r: 3.2 }));
}

function niceTicks(low, high, most) {
  const raw = (high - low || 1) / most, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw);
  const ticks = [];
  for (let value = Math.ceil(low / step) * step; value <= high + step * 1e-9; value += step) {
    ticks.push(Number(value.toPrecision(12)));
  }
  return ticks;
}

const DASHES = [null, '6 3', '2 3', '9 3 2 3', '4 2', '1 2', '12 4', '7 2 2 2'];

function linePlot({ label, lines, xLabel, yLabel, width = 760, height = 300, most = 0, isSmall = false }) {
  // Lines: {name, style, x: [], y: [], band: [[low, high]], titles: [], isScatter}; styles differ in colour and dash. The y
  // axis reaches `most`. Titles are of the points; a scatter has only points.
  // A small plot has no key and no download.
  const left = isSmall ? 40 : 62, right = 12, top = 22, bottom = 42;
  const xs = lines.flatMap((one) => one.x), ys = lines.flatMap((one) => one.y);
  const plot = svg('svg', { viewBox: `0 0 ${width} ${height}`, width, role: 'img', 'aria-label': label });
  if (!xs.length) return h('p', { class: 'intro' }, 'No timings.');
  const xHigh = Math.max(...xs, 1e-9), yHigh = Math.max(...ys, most, 1e-9) * 1.05;
  const px = (v) => left + (v / xHigh) * (width - left - right);
  const py = (v) => height - bottom - (v / yHigh) * (height - top - bottom);
  for (const tick of niceTicks(0, yHigh, 5)) {
    plot.append(svg('line', { class: 'grid', x1: left, x2: width - right, y1: py(tick), y2: py(tick) }),
      svg('text', { x: left - 6, y: py(tick) + 4, 'text-anchor': 'end' }, countText(tick)));
  }
  for (const tick of niceTicks(0, xHigh, Math.min(7, width / 60))) {
    plot.append(svg('text', { x: px(tick), y: height - bottom + 16, 'text-anchor': 'middle' }, countText(tick)));
  }
  plot.append(svg('line', { class: 'axis', x1: left, x2: width - right, y1: height - bottom, y2: height - bottom }),
    svg('text', { class: 'strong', x: (left + width - right) / 2, y: height - 6, 'text-anchor': 'middle' }, xLabel),
    svg('text', { class: 'strong', x: left, y: 12 }, yLabel));
  const at = (x, y) => `${px(x).toFixed(1)} ${py(Math.min(yHigh, Math.max(0, y))).toFixed(1)}`;
  for (const one of lines.filter((each) => each.band)) {
    const edge = (end) => one.x.map((v, i) => at(v, one.band[i][end]));
    plot.append(svg('path', { class: `band l${one.style % 8}`, d: `M${[...edge(0), ...edge(1).reverse()].join('L')}Z` }));
  }
  for (const one of lines) {
    const d = one.x.map((v, i) => `${i && !one.isScatter ? 'L' : 'M'}${px(v).toFixed(1)} ${py(one.y[i]).toFixed(1)}`).join('');
    plot.append(svg('path', { class: `line l${one.style % 8}`, d, 'stroke-dasharray': DASHES[one.style % 8] },
      svg('title', null, one.name)));
    const titleOf = (i) => (one.titles || [])[i] || one.name;
    const ring = { class: `l${one.style % 8}`, fill: 'none', 'stroke-width': 1.6, r: 2.6 };
    if (one.x.length < 30) one.x.forEach((v, i) => plot.append(svg('circle', { ...ring, cx: px(v), cy: py(one.y[i]) },
      svg('title', null, `${titleOf(i)}: ${countText(one.y[i])}`))));
  }
  if (isSmall) return plot;
  return h('div', null, lineKey(lines), scrollBox(label, plot),
    downloadButton('PNG', label, () => savePlot(label, plot, lines)));
}

function lineKey(lines) {
  const dash = (style) => svg('svg', { width: 30, height: 8, 'aria-hidden': 'true' },
    svg('line', { class: `line l${style}`, x1: 0, x2: 30, y1: 4, y2: 4, 'stroke-dasharray': DASHES[style] }));
  return h('ul', { class: 'key' }, lines.map((one) => h('li', null, dash(one.style % 8), one.name)));
}

// The picture of a plot with its key, at twice the size of the screen.
function savePlot(label, plot, lines) {
  const { width, height } = plot.viewBox.baseVal, tall = height + 18 * lines.length + 6, copy = plot.cloneNode(true);
  const parts = [...plot.querySelectorAll('*')];
  [...copy.querySelectorAll('*')].forEach((part, k) => {  // an image has no style sheet
    const style = getComputedStyle(parts[k]);
    for (const name of ['fill', 'stroke', 'stroke-width', 'font-size', 'font-family']) part.setAttribute(name, style[name]);
  });
  const ink = getComputedStyle(document.body).color, paths = [...plot.querySelectorAll('path')];
  copy.prepend(svg('rect', { width, height: tall, fill: getComputedStyle(document.body).backgroundColor }));
  lines.forEach((one, k) => copy.append(
    svg('line', { x1: 62, x2: 92, y1: height + 18 * k + 6, y2: height + 18 * k + 6, 'stroke-width': 1.8,
      stroke: getComputedStyle(paths[k]).stroke, 'stroke-dasharray': DASHES[one.style % 8] }),
    svg('text', { x: 98, y: height + 18 * k + 10, fill: ink, 'font-size': 12, 'font-family': 'sans-serif' }, one.name)));
  fill(copy, { viewBox: `0 0 ${width} ${tall}`, width: 2 * width, height: 2 * tall, xmlns: SVG }, []);
  const image = new Image();
  image.onload = () => {
    const canvas = h('canvas', { width: 2 * width, height: 2 * tall });
    canvas.getContext('2d').drawImage(image, 0, 0);
    save(fileName(label, 'png'), canvas.toDataURL('image/png'));
  };
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(new XMLSerializer().serializeToString(copy))}`;
}
