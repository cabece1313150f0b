// Puts the page together.

function headFacts() {
  const n = (values) => new Set(values).size;
  const facts = [[n(RUNS.flatMap((run) => run.scenes)), 'scene'], [n(RUNS.flatMap((run) => run.methods)), 'method'], [PROTOCOLS.length, 'protocol']];
  byId('main').append(h('ul', { class: 'facts' }, RUNS.length > 1 ? h('li', null, h('b', null, String(RUNS.length)), ' runs') : null,
    facts.map(([count, what]) => h('li', null, h('b', null, String(count)), ` ${what}${count === 1 ? '' : 's'}`)),
    RUNS.length === 1 && RUNS[0].profile ? h('li', null, 'profile ', h('b', null, RUNS[0].profile)) : null,
    RUNS.length === 1 && RUNS[0].encoder ? h('li', null, 'encoder ', h('b', null, RUNS[0].encoder)) : null));
}

function followSections() {
  const links = [...byId('nav').querySelectorAll('a')], sections = [...document.querySelectorAll('section.part')];
  const mark = () => {
    const at = sections.filter((section) => section.getBoundingClientRect().top < 140).pop() || sections[0];
    links.forEach((link) => {
      const is = at && link.getAttribute('href') === `#${at.id}`;
      if (is === link.hasAttribute('aria-current')) return;
      if (is) { link.setAttribute('aria-current', 'true'); byId('nav').scrollLeft = link.offsetLeft - byId('nav').offsetLeft - 40; } else link.removeAttribute('aria-current');
    });
  };
  let waiting = false;
  document.addEventListener('scroll', () => { if (!waiting) { waiting = true; requestAnimationFrame(() => { waiting = false; mark(); }); } }, { passive: true });
  mark();
}

headFacts();
for (const make of [summarySection, mapsSection, scenesSection, classesSection, confusionSection, errorsSection, timingSection, compareSection, provenanceSection]) make();
followSections();
