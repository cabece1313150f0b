// Cost against quality on the pages of runs and of registries. Entries: {method, metric, value, machine, data} and costs;
// only entries of one machine and of the same data, rules included, share a plot. COSTS: [key, label] of each cost.

// The points, by rising cost, for which no other has a higher value at the same cost or less.
function frontOf(points) {
  const sorted = [...points].sort((a, b) => a.x - b.x || b.y - a.y);
  return sorted.filter((one, k) => sorted.slice(0, k).every((other) => other.y < one.y));
}

function costPlots(entries) {
  const isKnown = (key) => !key.startsWith('n_') && entries.some((one) => isNumber(one[key]) && isNumber(one.value));
  const known = COSTS.filter(([key]) => isKnown(key)).sort(([a], [b]) => (a === 'rate_hz') - (b === 'rate_hz'));
  if (!known.length) return h('div');
  const unique = (values) => [...new Set(values)], methods = unique(entries.map((one) => one.method)), place = h('div');
  const metrics = unique(entries.map((one) => one.metric));
  const metric = select('Metric', metrics.map((name) => [name, name]), metrics[0], draw);
  const cost = select('Against', known, known[0][0], draw);
  const line = (name, style, points) => ({ name, style, x: points.map((one) => one.x), y: points.map((one) => one.y),
    titles: points.map((one) => (one.rate_hz ? `${one.method} at ${one.rate_hz} Hz` : one.method)) });
  function draw() {
    const name = metric.input.value, key = cost.input.value, xLabel = known.find(([one]) => one === key)[1];
    const points = entries.filter((one) => one.metric === name && isNumber(one[key]) && isNumber(one.value))
      .map((one) => ({ ...one, x: one[key], y: isCount(name) ? one.value : 100 * one.value }));
    const groupOf = (one) => `${one.machine}\n${one.data}`;
    place.replaceChildren(...unique(points.map(groupOf)).flatMap((group) => {
      const mine = points.filter((one) => groupOf(one) === group), { machine } = mine[0];
      const lines = methods.map((method, k) => line(method, k, mine.filter((one) => one.method === method)
        .sort((a, b) => a.x - b.x))).filter((one) => one.x.length).map((one) => ({ ...one, isScatter: key !== 'rate_hz' }));
      const front = key === 'rate_hz' ? [] : [line('Pareto front', methods.length, frontOf(mine))];
      return [h('p', { class: 'intro' }, machine), linePlot({ label: `${name} against ${xLabel} on ${machine}`,
        lines: [...front, ...lines], xLabel, yLabel: isCount(name) ? name : `${name} in per cent` })];
    }));
  }
  draw();
  return h('div', null, h('div', { class: 'toolbar' }, metric, cost), place);
}
