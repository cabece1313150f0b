// Robustness: scores of a sweep against the severity, and what the corruptions do to one scene.

function robustnessSection() {
  if (!SWEEPS.length) return;
  part('robustness', 'Robustness', 'Scores under corruptions of the inputs, in per cent. Severity 0 is the clean score; the '
    + 'band is the 95 % interval of its change, paired over scenes.', (section) => SWEEPS.forEach((sweep) => {
    if (RUNS.length > 1) section.append(h('h3', null, runNames[sweep.run]));
    if (sweep.reason) section.append(h('p', { class: 'note' }, sweep.reason));
    if (!sweep.results.length) return;
    const place = h('div'), field = protocolField(sweep.results.map((one) => one.protocol));
    section.append(h('div', { class: 'toolbar' }, field), place);
    const draw = () => {
      const result = sweep.results.find((one) => one.protocol === field.protocol());
      place.replaceChildren();
      fill(place, null, [sweepTable(sweep, result), noteList(result.notes), sweepPlots(sweep, result)]);
    };
    chosen.listeners.push(draw);
    field.input.addEventListener('change', draw);
    draw();
  }));
}

function sweepTable(sweep, result) {
  const families = [...new Set(result.methods.flatMap((one) => Object.keys(one.families)))];
  const change = (label, of) => ({ label, num: true, value: (one) => (of(one) ? of(one).difference : null),
    show: (one) => (!of(one) ? '–' : [signed(of(one).difference), of(one).interval
      ? h('small', null, ` [${of(one).interval.map(signed).join(', ')}]`) : null]) });
  const share = (label, key) => ({ label, num: true, value: (one) => one[key], show: (one) => percent(one[key]) });
  return dataTable({
    caption: `${result.protocol}: ${result.metric} under corruptions`,
    rows: result.methods,
    columns: [
      { label: 'Method', value: (one) => sideName(sweep.run, one.method) }, share(`Clean ${result.metric}`, 'clean'),
      ...families.map((family) => change(family, (one) => one.families[family])), change('mean', (one) => one.mean),
      share('mCE', 'mce'), share('Resilience', 'resilience'),
    ],
  });
}

function sweepPlots(sweep, result) {
  const most = 100 * Math.max(...result.methods.map((one) => one.clean)), linesOf = {};
  for (const one of result.methods) {
    const style = styleOf(sweep.run, one.method), clean = 100 * one.clean;
    for (const [name, cell] of Object.entries(one.cells)) {
      const [corruption, severity] = sweep.conditions[name], lines = linesOf[corruption] ||= {};
      const line = lines[one.method] ||= { name: sideName(sweep.run, one.method), style, points: [[0, clean, [clean, clean]]] };
      if (severity && isNumber(cell.value)) {
        const changes = cell.interval || [cell.difference, cell.difference];
        line.points.push([severity, 100 * cell.value, changes.map((end) => clean + 100 * end)]);
      }
    }
  }
  const inOrder = (lines) => Object.values(lines).map(({ points, ...line }) => {
    points.sort((a, b) => a[0] - b[0]);
    const hasBand = points.some(([, , [low, high]]) => low < high);
    return { ...line, x: points.map(([x]) => x), y: points.map(([, y]) => y), band: hasBand && points.map(([, , ends]) => ends) };
  });
  const block = (name) => {
    const { unit, pictures } = sweep.corruptions[name];
    const shown = pictures.map(([text, jpeg]) => h('figure', null,
      h('img', { src: `data:image/jpeg;base64,${jpeg}`, width: 160, height: 120, alt: `${name} at severity ${text} ${unit}` }),
      h('figcaption', null, text)));
    return h('div', { class: 'corruption' }, h('h3', null, `${name}, ${unit}`),
      linePlot({ label: `${result.metric} against the severity of ${name}`, lines: inOrder(linesOf[name]), most,
        xLabel: 'severity', yLabel: `${result.metric}, %`, width: 320, height: 170, isSmall: true }),
      h('div', { class: 'tiles' }, shown));
  };
  const families = [...new Set(Object.values(sweep.corruptions).map((one) => one.family))];
  const names = (family) => Object.keys(linesOf).filter((name) => sweep.corruptions[name].family === family);
  return [
    h('p', { class: 'keys' }, sweep.no_pictures ? `No pictures: ${sweep.no_pictures}`
      : `Pictures: a frame of ${sweep.scene}, its trajectory, perfect masks or names, with severity and value.`),
    lineKey(result.methods.map((one) => ({ name: sideName(sweep.run, one.method), style: styleOf(sweep.run, one.method) }))),
    ...families.map((family, k) => h('details', { open: k === 0 },
      h('summary', null, `${family}: ${plural(names(family).length, 'corruption')}`), names(family).map(block))),
  ];
}
