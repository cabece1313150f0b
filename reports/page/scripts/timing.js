// Timing: updates over time, methods, stages, intermediate maps.

function timingSection() {
  if (!DATA.timing.length) return;
  part('timing', 'Timing', 'Time per update. A stage “cache” means that perception was read from its cache; “map” '
    + 'is everything except reading the frame and perception.', (section) => {
    section.append(h('ul', { class: 'facts' }, RUNS.map((run, k) =>
      h('li', null, RUNS.length > 1 ? `${runNames[k]}: ` : '', h('b', null, run.hardware)))));
    coursePlot(section);
    section.append(h('h3', null, 'Methods'), methodTimes());
    const below = h('div');
    const side = select('Stages of', DATA.timing.map((one, k) => [k, nameOf(one)]), 0, draw);
    section.append(h('div', { class: 'toolbar' }, side), below);
    function draw() { below.replaceChildren(stageTimes(DATA.timing[side.input.value])); }
    draw();
    anytime(section);
    costQuality(section);
  });
}

function coursePlot(section) {
  const scenes = [...new Set(DATA.timing.flatMap((one) => Object.keys(one.series)))], place = h('div');
  const scene = select('Scene', scenes.map((name) => [name, name]), scenes[0], plot);
  const what = select('Time', [['map', 'map only'], ['total', 'complete update']], 'map', plot);
  const axes = [['updates', 'number of updates'], ['points', 'number of map points']];
  const against = select('x axis', axes, 'updates', plot);
  section.append(h('div', { class: 'toolbar' }, scene, what, against), place);
  function plot() {
    const name = scene.input.value, byPoints = against.input.value === 'points';
    const usable = DATA.timing.filter((one) => one.series[name]);
    const lines = usable.map((one) => {
      const series = one.series[name];
      const updates = series.total.map((_, k) => Math.min(series.n, (k + 1) * series.per));
      const x = byPoints ? series.points || [] : updates;
      const y = x.length ? series[what.input.value] : [];
      return { name: nameOf(one), style: styleOf(one.run, one.method), x, y };
    }).filter((line) => line.x.length);
    const per = Math.max(1, ...usable.map((one) => one.series[name].per));
    const yLabel = `ms per update${per > 1 ? ` (mean of up to ${per} updates)` : ''}`, [, xLabel] = axes[byPoints ? 1 : 0];
    place.replaceChildren(linePlot({ label: `Milliseconds per update in ${name}`, lines, xLabel, yLabel }));
  }
  plot();
}

const growthWords = (one) => (one.by_points || one.by_updates || { words: 'too few updates' }).words;

function methodTimes() {
  const stage = (one, name) => one.stages.find((each) => each.name === name) || {};
  const mib = (bytes) => (isNumber(bytes) ? (bytes / 2 ** 20).toFixed(0) : '–');
  const ms = (label, value) => ({ label, num: true, value, show: (one) => msText(value(one)) });
  const bytes = (label, key) => ({ label, num: true, value: (one) => one[key], show: (one) => mib(one[key]) });
  return dataTable({
    caption: 'All scenes; milliseconds per update, excluding the first three of each scene', rows: DATA.timing,
    columns: [
      { label: 'Method', value: nameOf }, { label: 'Updates', num: true, value: (one) => one.n_updates },
      ...['p50', 'p95', 'max', 'first'].map((key) => ms(key, (one) => stage(one, 'total')[key])),
      ms('map p50', (one) => stage(one, 'map').p50),
      { label: 'Growth with map size', value: (one) => growthWords(stage(one, 'map')) },
      ms('Finish', (one) => one.finish_ms),
      { label: 'Points', num: true, value: (one) => one.n_points, show: (one) => countText(one.n_points) },
      bytes('Map MiB', 'map_bytes'), bytes('Peak MiB', 'peak_rss_bytes'), bytes('GPU MiB', 'device_bytes'),
    ],
  });
}

function stageTimes(one) {
  const growth = (g) => (g ? `${g.exponent.toFixed(2)} [${g.low.toFixed(2)}, ${g.high.toFixed(2)}]` : '–');
  const exponent = (label, key) => ({
    label, num: true, value: (row) => row[key] && row[key].exponent, show: (row) => growth(row[key]) });
  return dataTable({
    caption: `${nameOf(one)}: milliseconds per update by stage`, rows: one.stages,
    columns: [
      { label: 'Stage', value: (row) => row.name },
      ...['p50', 'p95', 'max', 'first'].map((key) => ({
        label: key, num: true, value: (row) => row[key], show: (row) => msText(row[key]) })),
      { label: 'Share', num: true, value: (row) => row.share, show: (row) => `${percent(row.share)} %` },
      exponent('Exponent over map points', 'by_points'), exponent('Exponent over instances', 'by_instances'),
      exponent('Exponent over updates', 'by_updates'),
      { label: 'Growth with map size', value: growthWords },
    ],
  });
}

function costQuality(section) {
  if (!DATA.costs.length) return;
  const place = h('div'), protocols = protocolField([...new Set(DATA.costs.map((one) => one.protocol))]);
  const draw = () => place.replaceChildren(costPlots(DATA.costs.filter((one) => one.protocol === protocols.protocol())));
  section.append(h('h3', null, 'Cost and quality'), h('div', { class: 'toolbar' }, protocols), place);
  chosen.listeners.push(draw);
  draw();
}

function anytime(section) {
  const midway = DATA.results.filter((one) => one.anytime.length && one.result);
  if (!midway.length) return;
  const place = h('div'), names = [...new Set(midway.map((one) => one.protocol))];
  const protocols = protocolField(names), metric = select('Metric', [], null, draw);
  section.append(h('h3', null, 'Intermediate maps'), h('div', { class: 'toolbar' }, protocols, metric), place);
  chosen.listeners.push(refresh);
  function refresh() {
    const first = midway.find((one) => one.protocol === protocols.protocol());
    if (!first) return;
    metric.setOptions(first.headline.map((name) => [name, name]), metric.input.value);
    draw();
  }
  function draw() {
    const name = metric.input.value;
    const line = (label, shares, style) => {
      const points = shares.filter(([, value]) => isNumber(value)).sort((a, b) => a[0] - b[0]);
      return { name: label, style, x: points.map(([share]) => 100 * share),
        y: points.map(([, value]) => (isCount(name) ? value : 100 * value)) };
    };
    const lines = midway.filter((one) => one.protocol === protocols.protocol()).flatMap((one) => {
      const style = styleOf(one.run, one.method), of = (curve) => curve.map((each) => [each.share, each.metrics[name]]);
      const whole = line(nameOf(one), [...of(one.anytime), [1, one.result.metrics[name]]], style);
      if (!one.seen.length) return [whole];
      return [whole, line(`${nameOf(one)}, seen so far`, of(one.seen), style + SIDES.length)];
    });
    place.replaceChildren(linePlot({ label: `${name} of intermediate maps`, lines,
      xLabel: 'percentage of frames', yLabel: isCount(name) ? name : `${name} in per cent` }));
  }
  refresh();
}
