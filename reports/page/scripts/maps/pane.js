// One view of a map with its title, tooltip and legend.

const DARK_PAPER = [26 / 255, 32 / 255, 39 / 255], LIGHT_PAPER = [246 / 255, 247 / 255, 249 / 255];
const NO_VIEW = 'This browser has no WebGL 2 (or no DecompressionStream), so the maps cannot be drawn. The tables '
  + 'are not affected.';
const VIEW_LOST = 'The browser lost the 3D context; wait for it to be restored or reload the page.';

// `nameOf(found)`: the tooltip of the object under the pointer, a name and further lines.
function mapPane({ eye, keysId, onMove, onPick, nameOf }) {
  const canvas = h('canvas', { tabindex: '0', role: 'application', 'aria-label': '3D view of the map',
    'aria-describedby': keysId });
  const say = h('div', { class: 'say', hidden: true, role: 'status' });
  const name = h('div', { class: 'name', hidden: true, 'aria-hidden': 'true' }), title = h('div', { class: 'title' });
  const stage = h('div', { class: 'stage' }, canvas, title, name, say);
  const legend = h('ul', { class: 'key legend', 'aria-label': 'Colours', tabindex: '0' });
  const pane = { node: h('div', { class: 'pane' }, stage, legend), stage, canvas, view: null, map: null, kind: null };

  pane.tell = (text) => { say.textContent = text; say.hidden = !text; };
  function hover(found, x, y) {
    const lines = found && pane.map ? nameOf(found) : null;
    name.hidden = !lines;
    canvas.classList.toggle('on', !!lines);
    if (!lines) return;
    name.replaceChildren(h('b', null, lines[0]), ...lines.slice(1).map((line) => h('span', null, line)));
    const isRight = x > canvas.clientWidth / 2, isLow = y > canvas.clientHeight / 2;
    Object.assign(name.style, {
      left: isRight ? 'auto' : `${x + 14}px`, right: isRight ? `${canvas.clientWidth - x + 14}px` : 'auto',
      top: isLow ? 'auto' : `${y + 14}px`, bottom: isLow ? `${canvas.clientHeight - y + 14}px` : 'auto',
    });
  }
  pane.open = () => {
    const handlers = { eye, onMove, onHover: hover, onLost: (isLost) => pane.tell(isLost ? VIEW_LOST : ''),
      onPick: (found, x, y) => { hover(found, x, y); onPick(found); } };
    try {
      pane.view = typeof DecompressionStream === 'undefined' ? null : mapView(canvas, handlers);
    } catch (error) { pane.view = null; }
    if (pane.view) {
      const dark = window.matchMedia('(prefers-color-scheme: dark)');
      const onTheme = () => pane.view.onPaper(dark.matches ? DARK_PAPER : LIGHT_PAPER);
      dark.addEventListener('change', onTheme);
      onTheme();
      return;
    }
    canvas.remove();
    pane.tell(NO_VIEW);
    say.style.position = 'static';
  };
  pane.show = (map) => {
    pane.map = map;
    hover(null);
    if (!map && pane.view) pane.view.nothing();
    if (!map) legend.replaceChildren();
  };
  // Colours the map; the first call also gives it to the view.
  pane.paint = (heading, kind, query, judged) => {
    const made = painted(pane.map, kind, query, judged), isNew = pane.drawn !== pane.map;
    pane.drawn = pane.map;
    if (pane.view && isNew) pane.view.show(pane.map, made.colours, pane.map.instances.map((one) => one.born || 0));
    else if (pane.view) pane.view.colour(made.colours);
    legend.replaceChildren(...made.legend.map(legendEntry));
    title.textContent = heading;
    canvas.setAttribute('aria-label', `3D view of ${heading}, coloured by ${kind}`);
  };
  pane.choose = (index) => {
    if (pane.view) pane.view.choose(index);
    for (const entry of legend.children) {
      const is = index >= 0 && entry.dataset.instance === String(index);
      if (!is) { entry.removeAttribute('aria-current'); continue; }
      entry.setAttribute('aria-current', 'true');
      legend.scrollTop = entry.offsetTop - legend.offsetTop;
    }
  };
  return pane;
}
