// Turns pointers, the wheel and keys into movements of the camera, and a press without a movement into a click.

const TURN_PER_PIXEL = 0.007;
const CLICK_PIXELS = 5;
const KEY_TURN = 0.12;
const KEY_ZOOM = 1.15;

/**
 * Moves `camera` by what happens on `target`. `moved` is called after each movement, `clicked` with the place of a click, and
 * `entered` on Enter.
 */
export function listen(target, camera, { moved, clicked, entered, reset }) {
  const pointers = new Map();
  let travelled = 0;

  target.addEventListener("pointerdown", (event) => {
    if (event.button > 2) return;
    target.setPointerCapture(event.pointerId);
    travelled = pointers.size === 0 ? 0 : Infinity;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  target.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = { x: event.clientX, y: event.clientY };
    const [right, down] = [now.x - before.x, now.y - before.y];
    travelled += Math.abs(right) + Math.abs(down);
    if (pointers.size === 2) {
      const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
      const apart = (pointer) => Math.hypot(pointer.x - other.x, pointer.y - other.y) || 1;
      camera.zoomBy(apart(now) / apart(before));
      camera.pan(right / 2 / target.clientHeight, -down / 2 / target.clientHeight);
    } else if (event.shiftKey || event.buttons & 6) {
      camera.pan(right / target.clientHeight, -down / target.clientHeight);
    } else {
      camera.turn(right * TURN_PER_PIXEL, down * TURN_PER_PIXEL);
    }
    pointers.set(event.pointerId, now);
    moved();
  });
  const released = (event) => {
    const known = pointers.delete(event.pointerId);
    if (!known || event.type !== "pointerup" || event.button !== 0 || travelled > CLICK_PIXELS) return;
    const place = target.getBoundingClientRect();
    clicked(event.clientX - place.left, event.clientY - place.top);
  };
  target.addEventListener("pointerup", released);
  target.addEventListener("pointercancel", released);
  target.addEventListener("contextmenu", (event) => event.preventDefault());
  target.addEventListener("wheel", (event) => {
    event.preventDefault();
    // Lines and pages, which some mice report, are made pixels.
    const pixels = event.deltaY * [1, 16, 400][event.deltaMode];
    camera.zoomBy(Math.exp(-pixels * 0.0015));
    moved();
  }, { passive: false });
  target.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "Enter") return entered();
    const step = event.shiftKey ? 0.05 : KEY_TURN;
    const turn = (right, down) => (event.shiftKey ? camera.pan(right, -down) : camera.turn(right, down));
    const keys = {
      ArrowLeft: () => turn(-step, 0),
      ArrowRight: () => turn(step, 0),
      ArrowUp: () => turn(0, -step),
      ArrowDown: () => turn(0, step),
      "+": () => camera.zoomBy(KEY_ZOOM),
      "=": () => camera.zoomBy(KEY_ZOOM),
      "-": () => camera.zoomBy(1 / KEY_ZOOM),
      0: reset,
    };
    const act = keys[event.key];
    if (!act) return;
    event.preventDefault();
    act();
    moved();
  });
}
