// Accessibility and layout checks of an open page: `looks`, only for tests.
'use strict';
globalThis.looks = (() => {
  const CONTROLS = 'a[href], button, select, input:not([type=hidden]), textarea, summary, [tabindex], [contenteditable]';
  const pen = new OffscreenCanvas(1, 1).getContext('2d', { willReadFrequently: true });
  const known = new Map();

  // Any CSS colour as red, green, blue in 0..255 and alpha in 0..1.
  function rgba(text) {
    if (!known.has(text)) {
      pen.clearRect(0, 0, 1, 1);
      pen.fillStyle = text;
      pen.fillRect(0, 0, 1, 1);
      const [r, g, b, a] = pen.getImageData(0, 0, 1, 1).data;
      known.set(text, [r, g, b, a / 255]);
    }
    return known.get(text);
  }
  const mix = (under, over, share) => under.map((value, k) => value + (over[k] - value) * share);
  const over = (under, colour) => mix(under, colour.slice(0, 3), colour[3]);
  const luminance = (rgb) => rgb.map((value) => value / 255)
    .map((v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
    .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
  function contrastOf(a, b) {
    const [low, high] = [luminance(a), luminance(b)].sort((x, y) => x - y);
    return (high + 0.05) / (low + 0.05);
  }

  const isShown = (el) => el.checkVisibility({ visibilityProperty: true }) && el.getClientRects().length > 0;
  const isOff = (el) => !!el.closest(':disabled, [aria-disabled=true], [inert]');
  const isTabStop = (el) => el.tabIndex >= 0 && isShown(el) && !isOff(el);
  const squeezed = (text) => (text || '').replace(/\s+/g, ' ').trim();
  const nameOf = (el) => squeezed(el.labels?.[0]?.textContent || el.getAttribute('aria-label') || el.textContent
    || el.title || el.alt).slice(0, 60);
  function placeOf(el) {
    const part = (one) => one.localName + (one.id && !/\d$/.test(one.id) ? `#${one.id}`
      : [...one.classList].map((name) => `.${name}`).join(''));
    const chain = [];
    for (let one = el; one && one !== document.body && chain.length < 4; one = one.parentElement) {
      chain.unshift(part(one));
      if (one.id && one !== el) break;
    }
    return chain.join(' > ');
  }
  const told = (el, text = nameOf(el)) => `${placeOf(el)} “${squeezed(text).slice(0, 40)}”`;

  // The background of an element and the colour of its text on it, and whether the background may be something else:
  // a picture, a gradient, or whatever is below a positioned element.
  function painted(el, colour) {
    const chain = [];
    for (let one = el; one; one = one.parentElement) chain.unshift(one);
    const isDark = matchMedia('(prefers-color-scheme: dark)').matches
      && getComputedStyle(document.documentElement).colorScheme.includes('dark');
    let isOverOther = false;
    function walk(k, under) {
      const style = getComputedStyle(chain[k]), own = rgba(style.backgroundColor);
      if (own[3] === 1) isOverOther = false;
      else if (['absolute', 'fixed'].includes(style.position) || chain[k].localName === 'svg') isOverOther = true;
      if (style.backgroundImage !== 'none') isOverOther = true;
      const ground = over(under, own), share = Number(style.opacity);
      const [beneath, above] = k === chain.length - 1 ? [ground, over(ground, colour)] : walk(k + 1, ground);
      return [mix(under, beneath, share), mix(under, above, share)];
    }
    const [beneath, above] = walk(0, isDark ? [18, 18, 18] : [255, 255, 255]);
    return { beneath, above, isOverOther };
  }
  function* texts(root = document.body) {
    const walker = document.createTreeWalker(root, NodeFilter.SHOW_TEXT), range = document.createRange();
    for (let node = walker.nextNode(); node; node = walker.nextNode()) {
      const el = node.parentElement;
      if (!node.data.trim() || el.closest('script, style, noscript, template, select, textarea') || !isShown(el)) continue;
      range.selectNodeContents(node);
      const rects = [...range.getClientRects()].filter((one) => one.width > 0 && one.height > 0);
      if (rects.length) yield { el, text: node.data, style: getComputedStyle(el), box: range.getBoundingClientRect() };
    }
    for (const el of root.querySelectorAll('select, textarea, input')) {
      if (!isShown(el) || ['range', 'checkbox', 'radio', 'color', 'hidden', 'file'].includes(el.type)) continue;
      const isHint = !el.value && !!el.placeholder, style = getComputedStyle(el, isHint ? '::placeholder' : null);
      yield { el, text: isHint ? el.placeholder : el.value, style, box: el.getBoundingClientRect() };
    }
    for (const el of root.querySelectorAll('*')) {
      for (const part of ['::before', '::after', '::marker']) {
        const style = getComputedStyle(el, part), { content } = style;
        if (/^"/.test(content) && squeezed(content.slice(1, -1)) && isShown(el)) {
          yield { el, text: content.slice(1, -1), style, box: el.getBoundingClientRect(), isSign: !/[\p{L}\d]/u.test(content) };
        }
      }
    }
  }
  const colourOf = (one) => rgba(one.el.ownerSVGElement ? one.style.fill : one.style.color);
  // 4.5 for text, 3 for large text and for symbols.
  function needed({ style, isSign }) {
    const size = parseFloat(style.fontSize);
    return isSign || size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700) ? 3 : 4.5;
  }

  let pending = [];
  // Texts with too little contrast; those whose background needs a screenshot are kept for `overOther`.
  function paleTexts(root) {
    const found = new Set();
    pending = [];
    for (const one of texts(root)) {
      if (isOff(one.el)) continue;
      const { beneath, above, isOverOther } = painted(one.el, colourOf(one));
      if (isOverOther) { pending.push({ ...one, above }); continue; }
      const ratio = contrastOf(beneath, above), least = needed(one);
      if (ratio < least) found.add(`${told(one.el, one.text)}: contrast ${ratio.toFixed(2)}, below ${least}`);
    }
    return [...found];
  }
  // Scrolls to the next kept text; returns all kept texts on the screen with their boxes.
  function overOther() {
    const on = (box) => box.width > 0 && box.top >= 0 && box.left >= 0 && box.bottom <= innerHeight && box.right <= innerWidth;
    const now = (one) => {
      const moved = document.createRange();
      moved.selectNodeContents(one.el);
      return one.el.value === undefined ? moved.getBoundingClientRect() : one.el.getBoundingClientRect();
    };
    const [first] = pending;
    if (!first) return [];
    first.el.scrollIntoView({ block: 'center', inline: 'center', behavior: 'instant' });
    const seen = pending.filter((one) => one === first || on(now(one)));
    pending = pending.filter((one) => !seen.includes(one));
    return seen.map((one) => [one, now(one)]).filter(([, box]) => on(box)).map(([one, box]) => ({
      text: told(one.el, one.text), colour: one.above, least: needed(one),
      box: [box.left, box.top, box.right, box.bottom] }));
  }
  const noText = new CSSStyleSheet();
  noText.replaceSync('* { color: transparent !important; -webkit-text-fill-color: transparent !important; '
    + 'caret-color: transparent !important; text-shadow: none !important; } svg text { fill: transparent !important; }');
  function hideTexts(isHidden) {
    document.adoptedStyleSheets = document.adoptedStyleSheets.filter((one) => one !== noText)
      .concat(isHidden ? [noText] : []);
  }

  const stops = () => [...document.querySelectorAll(CONTROLS)].filter(isTabStop).filter((el) => el.type !== 'radio'
    || el.checked || ![...document.getElementsByName(el.name)].some((one) => one.checked));
  const scrolls = (el) => /auto|scroll/.test(getComputedStyle(el).overflow)
    && (el.scrollWidth > el.clientWidth + 1 || el.scrollHeight > el.clientHeight + 1);
  const isInSentence = (el) => getComputedStyle(el).display === 'inline' && !!el.parentElement
    && squeezed(el.parentElement.textContent).length > squeezed(el.textContent).length;

  function smallTargets(least) {
    const found = new Set();
    for (const el of stops()) {
      if (el.localName === 'a' && isInSentence(el)) continue;
      if (!el.matches('a, button, select, input, textarea, summary, canvas') && getComputedStyle(el).cursor === 'auto') continue;
      const boxes = [el, ...(['checkbox', 'radio'].includes(el.type) ? el.labels : [])].map((one) => one.getBoundingClientRect());
      const size = ['width', 'height'].map((side) => Math.max(...boxes.map((box) => box[side])));
      if (boxes[0].right <= 0 || boxes[0].bottom + scrollY <= 0) continue; // outside the page until it has the focus
      if (Math.min(...size) < least - 0.01) {
        found.add(`${told(el)}: target of ${size.map((one) => one.toFixed(0)).join(' x ')} px, below ${least}`);
      }
    }
    return [...found];
  }
  function smallTexts(least) {
    const found = new Set();
    for (const one of texts()) {
      const scale = one.el.ownerSVGElement ? one.el.getScreenCTM().a : 1, size = scale * parseFloat(one.style.fontSize);
      if (size < least - 0.01) found.add(`${told(one.el, one.text)}: text of ${size.toFixed(1)} px, below ${least}`);
    }
    return [...found];
  }
  // Elements that extend beyond the screen and are not in a scrolling box.
  function sideways(width) {
    if (document.documentElement.scrollWidth <= width) return [];
    const isBoxed = (el) => { // or in a clipping box
      for (let one = el.parentElement; one && one !== document.body; one = one.parentElement) {
        if (getComputedStyle(one).overflowX !== 'visible') return true;
      }
      return false;
    };
    const wide = [...document.body.querySelectorAll('*')].filter((el) =>
      isShown(el) && el.getBoundingClientRect().right > width + 1 && !isBoxed(el));
    const inner = wide.filter((el) => !wide.some((one) => one !== el && el.contains(one)));
    return [`the page is ${document.documentElement.scrollWidth} px wide on a screen of ${width}: `
      + inner.slice(0, 5).map((el) => told(el)).join('; ')];
  }
  // Texts that are clipped without scrolling or an ellipsis.
  function cutTexts() {
    const found = new Set();
    for (const { el, text } of texts()) {
      const style = getComputedStyle(el), cuts = (value) => value === 'hidden' || value === 'clip';
      if (el.value !== undefined || style.textOverflow === 'ellipsis') continue;
      if ((cuts(style.overflowX) && el.scrollWidth > el.clientWidth + 1)
        || (cuts(style.overflowY) && el.scrollHeight > el.clientHeight + 1)) found.add(`${told(el, text)}: is clipped`);
    }
    return [...found];
  }
  // Content missing from a printed page, because its box scrolls or covers others.
  function unprinted() {
    const found = new Set();
    for (const el of document.body.querySelectorAll('*')) {
      if (!isShown(el) || el.matches('select, input, textarea, option')) continue;
      const style = getComputedStyle(el);
      if (/auto|scroll|hidden/.test(style.overflowY) && el.scrollHeight > el.clientHeight + 1 && el.clientHeight > 1) {
        found.add(`${told(el)}: ${el.scrollHeight - el.clientHeight} px of it are not printed`);
      }
      if (style.position === 'fixed') found.add(`${told(el)}: is printed over each page`);
    }
    return [...found];
  }

  const isLight = () => luminance(painted(document.body, [0, 0, 0, 0]).beneath) > 0.2;
  const grounds = () => [...document.body.querySelectorAll('*')].filter((el) => isShown(el)
    && !el.matches('img, canvas, video')).map((el) => [told(el), rgba(getComputedStyle(el).backgroundColor)])
    .filter(([, colour]) => colour[3] > 0.5).map(([text, colour]) => [text, colour, luminance(colour.slice(0, 3))]);

  function moving() {
    const found = new Set();
    const isLong = (times) => times.split(',').some((one) => parseFloat(one) > (one.endsWith('ms') ? 10 : 0.01));
    for (const el of [document.documentElement, ...document.body.querySelectorAll('*')]) {
      const style = getComputedStyle(el);
      if (style.animationName !== 'none' && isLong(style.animationDuration)) found.add(`${told(el)}: is animated`);
      if (isLong(style.transitionDuration)) found.add(`${told(el)}: changes over ${style.transitionDuration}`);
      if (style.scrollBehavior === 'smooth') found.add(`${told(el)}: scrolls smoothly`);
    }
    return [...found, ...document.getAnimations().map((one) => `${one.animationName || 'an animation'}: runs`)];
  }

  function structure() {
    const found = [], all = (selector) => [...document.querySelectorAll(selector)], one = (selector) => all(selector).length === 1;
    const say = (is, text) => { if (!is) found.push(text); };
    say(document.documentElement.lang, 'the page has no language');
    say(document.title.trim(), 'the page has no title');
    say(document.characterSet === 'UTF-8' && document.compatMode === 'CSS1Compat', 'the page is not UTF-8 or has no doctype');
    say(document.querySelector('meta[name=viewport]'), 'the page has no viewport for phones');
    say(one('main'), `the page has ${all('main').length} main elements, not 1`);
    const headings = all('h1, h2, h3, h4, h5, h6').filter(isShown);
    say(headings.filter((el) => el.localName === 'h1').length === 1, 'the page does not have exactly one h1');
    headings.reduce((before, el) => {
      const level = Number(el.localName[1]);
      say(level <= before + 1, `${told(el)}: follows a heading of level ${before}`);
      return level;
    }, 0);
    for (const el of all('img')) {
      say(el.alt.trim() || (el.hasAttribute('alt') && el.closest('[aria-hidden=true]')), `${placeOf(el)}: picture without alternative text`);
    }
    for (const el of all('svg, canvas').filter(isShown)) {
      say(el.closest('[aria-hidden=true]') || (el.getAttribute('role') && (el.getAttribute('aria-label')
        || el.getAttribute('aria-labelledby'))), `${placeOf(el)}: drawing without role and label`);
    }
    for (const el of all('table').filter(isShown)) {
      say(el.caption || el.getAttribute('aria-label') || el.getAttribute('aria-labelledby'), `${told(el)}: table without a caption`);
      say([...el.querySelectorAll('th')].every((cell) => cell.scope), `${told(el)}: header without scope`);
    }
    const ids = all('[id]').map((el) => el.id);
    for (const id of new Set(ids.filter((text, k) => ids.indexOf(text) !== k))) found.push(`two elements have the id ${id}`);
    for (const name of ['aria-labelledby', 'aria-describedby', 'aria-controls', 'for']) {
      for (const el of all(`[${name}]`)) {
        for (const id of el.getAttribute(name).split(/\s+/)) say(document.getElementById(id), `${told(el)}: ${name} refers to no element`);
      }
    }
    for (const el of all('a[href^="#"]')) {
      say(document.getElementById(decodeURIComponent(el.hash.slice(1).split('?')[0])), `${told(el)}: dead link`);
    }
    for (const el of all('link[href], [src], [srcset], [poster], [background], form[action], object[data]')) {
      for (const key of ['href', 'src', 'srcset', 'poster', 'background', 'action', 'data']) {
        say(!/^\s*(https?:|wss?:|\/\/)/.test(el.getAttribute(key) || ''), `${placeOf(el)}: ${key} is outside the page`);
      }
    }
    return found;
  }
  function order() {
    const found = [];
    for (const el of document.body.querySelectorAll('*')) {
      if (el.tabIndex > 0) found.push(`${told(el)}: positive tabindex ${el.tabIndex}`);
      const style = getComputedStyle(el);
      if (style.order !== '0' || /reverse/.test(style.flexDirection)) {
        if (el.querySelector(CONTROLS) || el.matches(CONTROLS)) found.push(`${told(el)}: visual order differs from document order`);
      }
    }
    return found;
  }

  // All controls by a stable key: what it is, and its index among equal ones.
  function controls() {
    const counts = new Map();
    return stops().map((el) => {
      const table = el.closest('table'), part = el.closest('section, nav, dialog, aside, header, figure');
      const of = table ? [...document.querySelectorAll('table')].indexOf(table) : nameOf(el);
      const stem = `${part?.id || ''} ${placeOf(el)} ${el.closest('li, fieldset, canvas') ? '' : of}`;
      const n = counts.get(stem) || 0;
      counts.set(stem, n + 1);
      return { el, key: `${stem} ${n}`, n };
    });
  }
  const find = (key) => controls().find((one) => one.key === key)?.el;
  const partOf = (key) => find(key)?.closest('section, dialog, main') || document.body;
  const state = () => JSON.stringify([location.hash, scrollX, scrollY, document.title,
    [...document.body.children].filter((el) => el.localName !== 'script').map((el) => el.outerHTML),
    [...document.querySelectorAll('select, input, textarea')].map((el) => [el.value, el.checked]),
    [...document.querySelectorAll('[tabindex]')].map((el) => [el.scrollLeft, el.scrollTop]),
    [...document.querySelectorAll('dialog')].map((el) => el.open)]);

  return {
    paleTexts, overOther, hideTexts, stops, scrolls, told, smallTargets, smallTexts, sideways, cutTexts, unprinted, grounds, isLight,
    moving, structure, order, controls, find, partOf, state, isShown, isOff, listed: [], before: '',
    list() { this.listed = stops(); return this.listed.map((el) => told(el)); },
  };
})();
