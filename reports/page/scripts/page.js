// Builds the page.

function headFacts() {
  const n = (values) => new Set(values).size;
  const counts = [
    [n(RUNS.flatMap((run) => run.scenes)), 'scene'], [n(RUNS.flatMap((run) => run.methods)), 'method'],
    [PROTOCOLS.length, 'protocol'],
  ];
  const [only] = RUNS.length === 1 ? RUNS : [{}];
  const fact = (what, value) => (value ? h('li', null, `${what} `, h('b', null, value)) : null);
  byId('main').append(h('ul', { class: 'facts' },
    RUNS.length > 1 ? h('li', null, h('b', null, String(RUNS.length)), ' runs') : null,
    counts.map(([count, what]) => h('li', null, h('b', null, String(count)), ` ${what}${count === 1 ? '' : 's'}`)),
    fact('perception profile', only.profile), fact('encoder', only.encoder)));
}

function followSections() {
  const nav = byId('nav'), links = [...nav.querySelectorAll('a')];
  const sections = [...document.querySelectorAll('section.part')];
  const top = (section) => section.getBoundingClientRect().top;
  // At the end of the page several short sections may be visible: the one in the address, otherwise the last.
  const atEnd = () => sections.find((one) => `#${one.id}` === location.hash && top(one) > 0 && top(one) < innerHeight)
    || sections[sections.length - 1];
  const mark = () => {
    const isEnd = scrollY > 0 && innerHeight + scrollY >= document.documentElement.scrollHeight - 2;
    const at = isEnd ? atEnd() : sections.filter((section) => top(section) < 140).pop() || sections[0];
    links.forEach((link) => {
      const is = at && link.getAttribute('href') === `#${at.id}`;
      if (is === link.hasAttribute('aria-current')) return;
      if (!is) { link.removeAttribute('aria-current'); return; }
      link.setAttribute('aria-current', 'true');
      nav.scrollLeft = link.offsetLeft - nav.offsetLeft - 40;
    });
  };
  let waiting = false;
  const soon = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; mark(); });
  };
  document.addEventListener('scroll', soon, { passive: true });
  mark();
}

// The summary is built immediately; the other sections when the browser is idle, or before the user jumps to one.
function makeInTime() {
  const idle = window.requestIdleCallback || ((work) => setTimeout(work, 1));
  const next = () => {
    const [section] = unmade.keys();
    if (!section) return;
    idle(next, { timeout: 300 });
    makePart(section);
  };
  byId('main').setAttribute('aria-busy', 'true');
  byId('nav').addEventListener('click', makeAll);
  window.addEventListener('hashchange', makeAll);
  window.addEventListener('beforeprint', makeAll);
  makePart(byId('summary'));
  if (location.hash) makeAll();
  else idle(next, { timeout: 300 });
}

headFacts();
for (const make of [
  summarySection, robustnessSection, mapsSection, scenesSection, classesSection, confusionSection, errorsSection, gallerySection,
  timingSection, compareSection, provenanceSection,
]) make();
makeInTime();
followSections();
performance.mark('su3d-usable');
