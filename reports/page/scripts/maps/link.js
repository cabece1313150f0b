// What the view of the maps shows as the end of the page's address, and back. Nothing in an address is believed.

const LINK = '#maps?', MAX_LINK = 2000, MAX_FRAME = 1e9, MAX_OBJECT = 2 ** 31;
const mapKey = (one) => (RUNS.length > 1 ? `${one.run + 1}:${one.method}` : one.method);
const mapIndex = (scene, key) => DATA.maps.findIndex((one) => one.scene === scene && mapKey(one) === key);

function cameraText(eye) {
  return [eye.azimuth, eye.elevation, eye.distance, ...eye.target].map((value) => Number(value.toFixed(3))).join('_');
}
// The camera that a text says, or null where it says none that could be.
function cameraOf(text) {
  const parts = text.split('_'), values = parts.map(Number);
  if (values.length !== 6 || parts.some((part) => !part.trim()) || !values.every(Number.isFinite)) return null;
  const [azimuth, elevation, distance, ...target] = values;
  if ([azimuth, ...target].some((value) => Math.abs(value) > 1e5)) return null;
  return { azimuth: azimuth % (2 * Math.PI), elevation: within(elevation, LIMITS.elevation),
    distance: within(distance, LIMITS.distance), target };
}
function linkText(state, eye) {
  const said = new URLSearchParams();
  for (const [name, value] of Object.entries(state)) {
    if (value !== null && value !== undefined && value !== '') said.set(name, String(value));
  }
  if (eye) said.set('camera', cameraText(eye));
  return LINK + said.toString();
}
// What an address asks for, of what there is; null where it asks for no map of this page.
function readLink(hash) {
  if (!hash.startsWith(LINK) || hash.length > MAX_LINK) return null;
  const said = new URLSearchParams(hash.slice(LINK.length)), text = (name) => said.get(name) || '';
  const isWhole = (name) => /^\d{1,10}$/.test(text(name));
  const whole = (name, most) => (isWhole(name) && Number(text(name)) <= most ? Number(text(name)) : null);
  const yes = (name) => ({ yes: true, no: false })[text(name)] ?? null;
  const scene = text('scene'), index = mapIndex(scene, text('map'));
  if (index < 0) return null;
  const [, key] = text('beside').match(/^map:(.*)$/) || [], other = mapIndex(scene, key);
  const beside = text('beside') === 'truth' ? 'truth' : other >= 0 ? String(other) : '';
  const colour = COLOURINGS.some(([kind]) => kind === text('colour')) ? text('colour') : null;
  return { scene, index, beside, colour, text: whole('text', 1000), cut: whole('cut', 100),
    frame: whole('frame', MAX_FRAME), missed: yes('missed'), walls: yes('walls'), instance: whole('instance', 0xffff),
    object: whole('object', MAX_OBJECT), camera: cameraOf(text('camera')) };
}
// The address of what a single error is about: its instance, and the object of the truth beside; null without a map.
function linkToError(one) {
  const shown = DATA.maps.find((each) => each.run === one.run && each.scene === one.scene && each.method === one.method);
  if (!shown || shown.reason) return null;
  const [object] = shown.truth === one.truth ? one.objects : [], [instance] = one.rows;
  return linkText({ scene: one.scene, map: mapKey(shown), colour: one.family === 'semantic' ? 'class' : 'instance',
    beside: shown.truth === null ? null : 'truth', instance, object }, null);
}
