// Keys and gamepads steer the instrument: packets as messages.py has them, 40 times a second while something is held.
// A browser without a graphics card tells the server (drawing.js). What the server sends, overlay.js shows.
(() => {
  "use strict";
  const PERIOD = 25, DEAD = 0.12;
  const held = new Set();
  let arm = 0, socket = null, wasMoving = false, armButton = false, jaw = false, jawButton = false;
  const connect = () => {
    // Below the page's own address, which begins with the token.
    socket = new WebSocket(location.origin.replace(/^http/, "ws") + location.pathname.replace(/\/$/, "") + "/hand");
    socket.onmessage = (event) => window.surgsim.show(JSON.parse(event.data));
    socket.onopen = () => { if (window.surgsim.software) socket.send(new TextEncoder().encode("software")); };
    socket.onclose = () => { socket = null; setTimeout(connect, 1000); };
  };
  window.surgsim.send = (text) => { if (socket?.readyState === WebSocket.OPEN) socket.send(new TextEncoder().encode(text)); };
  const typing = () => {
    const at = document.activeElement;
    return at !== null && (at.isContentEditable || ["INPUT", "TEXTAREA", "SELECT"].includes(at.tagName));
  };
  const KEYS = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "PageUp", "PageDown"];
  // Before viser, whose camera would turn with the arrows.
  window.addEventListener("keydown", (event) => {
    if (typing() || event.ctrlKey || event.altKey || event.metaKey) return;
    if (event.code === "KeyX" && !event.repeat) arm = 1 - arm;
    if (event.code === "KeyG" && !event.repeat) jaw = true;
    if (!KEYS.includes(event.code)) return;
    held.add(event.shiftKey ? "Shift" + event.code : event.code);
    event.preventDefault();
    event.stopImmediatePropagation();
  }, true);
  window.addEventListener("keyup", (event) => {
    held.delete(event.code);
    held.delete("Shift" + event.code);
    if (KEYS.includes(event.code)) event.stopImmediatePropagation();
  }, true);
  window.addEventListener("blur", () => held.clear());
  const key = (...names) => (names.some((name) => held.has(name)) ? 1 : 0);
  const dead = (value) => (Math.abs(value) < DEAD ? 0 : value);
  setInterval(() => {
    let right = key("ArrowRight", "ShiftArrowRight") - key("ArrowLeft", "ShiftArrowLeft");
    let away = key("ArrowUp") - key("ArrowDown");
    let out = key("PageUp", "ShiftArrowUp") - key("PageDown", "ShiftArrowDown");
    for (const pad of navigator.getGamepads ? navigator.getGamepads() : []) {
      if (!pad || !pad.connected || pad.axes.length < 2) continue;
      right += dead(pad.axes[0]);
      away -= dead(pad.axes[1]);
      const pressed = (index) => (pad.buttons[index] ? pad.buttons[index].value : 0);
      out += pressed(6) - pressed(7) - (pad.axes.length > 3 ? dead(pad.axes[3]) : 0);
      const change = pressed(4) > 0.5 || pressed(5) > 0.5;
      if (change && !armButton) arm = 1 - arm;
      armButton = change;
      if (pressed(0) > 0.5 && !jawButton) jaw = true;
      jawButton = pressed(0) > 0.5;
      break;
    }
    const bound = (value) => Math.max(-1, Math.min(1, value));
    const moving = right !== 0 || away !== 0 || out !== 0;
    if ((moving || wasMoving || jaw) && socket !== null && socket.readyState === WebSocket.OPEN) {
      const packet = new DataView(new ArrayBuffer(16));
      [right, away, out].forEach((value, index) => packet.setFloat32(4 * index, bound(value), true));
      packet.setUint16(12, arm, true);
      packet.setUint16(14, jaw ? 1 : 0, true);
      jaw = false;
      socket.send(packet.buffer);
    }
    wasMoving = moving;
  }, PERIOD);
  connect();
})();
