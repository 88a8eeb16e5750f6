// Without a graphics card a browser draws without what nobody misses there.
window.surgsim = (() => {
  "use strict";
  const software = (() => {
    const gl = document.createElement("canvas").getContext("webgl2");
    if (gl === null) return false;
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    const name = String(gl.getParameter(info === null ? gl.RENDERER : info.UNMASKED_RENDERER_WEBGL));
    gl.getExtension("WEBGL_lose_context")?.loseContext();
    return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
  })();
  const state = { software };
  const frame = window.requestAnimationFrame.bind(window);
  if (!software) return state;

  // Smoothed edges, and a picture kept to be read again, cost a quarter of the time.
  const realContext = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, given) {
    const is3d = String(kind).startsWith("webgl");
    return realContext.call(this, kind, is3d ? { ...given, antialias: false, preserveDrawingBuffer: false } : given);
  };

  // viser draws on for a quarter of a second after each message, the same picture again and again: here a frame waits
  // for something new, for somebody who moves the view, or for a tenth of a second [ms].
  const LONGEST = 100, MOVED = 300;
  let fresh = true, moved = -Infinity, last = -Infinity;
  const RealWorker = window.Worker;
  window.Worker = class extends RealWorker {
    constructor(...given) { super(...given); this.addEventListener("message", () => { fresh = true; }); }
  };
  for (const kind of ["pointerdown", "pointermove", "wheel", "keydown"])
    window.addEventListener(kind, (event) => {
      if (kind !== "pointermove" || event.buttons) moved = performance.now();
    }, { capture: true, passive: true });
  const waiting = new Map();
  let number = 0, asked = false;
  const ask = () => { if (!asked) { asked = true; frame(draw); } };
  const draw = (now) => {
    asked = false;
    const at = performance.now();
    if (!fresh && at - last < LONGEST && at - moved > MOVED) { ask(); return; }
    fresh = false;
    last = at;
    const newest = number;
    for (const [key, callback] of waiting) {
      if (key > newest) break;
      waiting.delete(key);
      try { callback(now); } catch (error) { reportError(error); }
    }
  };
  window.requestAnimationFrame = (callback) => { waiting.set(++number, callback); ask(); return number; };
  window.cancelAnimationFrame = (key) => { waiting.delete(key); };
  return state;
})();
