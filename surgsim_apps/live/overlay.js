// Over the picture: force as a number and a bar, the search for a hidden lesion, how to steer; and a press from a click.
(() => {
  "use strict";
  const AMBER = "#f59f00", RED = "#fa5252", CALM = "#e9ecef", CLIP = "Film a clip";
  // Dark red, lighter in the middle, as light falls off in a body; a background of the scene would be drawn anew for
  // each picture, 40 ms without a graphics card.
  const style = `
    canvas[data-engine] { background: radial-gradient(circle at 38% 50%, #5a2120, #2d1011 55%, #150809); }
    #surgsim { position: fixed; top: 14px; left: 16px; z-index: 1000; color: ${CALM}; font-family: system-ui, sans-serif;
      text-shadow: 0 1px 3px #000c; pointer-events: none; user-select: none; max-width: calc(100vw - 32px); }
    #surgsim .number { font-size: 64px; font-weight: 700; line-height: 1; font-variant-numeric: tabular-nums; }
    #surgsim .number small { font-size: 24px; font-weight: 400; }
    #surgsim .bar { width: 240px; height: 12px; margin: 8px 0; border-radius: 6px; background: #0008; overflow: hidden; }
    #surgsim .bar i { display: block; height: 100%; width: 0; border-radius: 6px; }
    #surgsim .text { font-size: 16px; margin: 8px 0; white-space: pre-line; max-width: 260px; }
    #surgsim button { pointer-events: auto; display: block; margin: 6px 0; font: 600 16px system-ui, sans-serif; padding: 10px 18px; border: 0;
      border-radius: 8px; background: #e8590c; color: #fff; cursor: pointer; }
    #surgsim .clip { background: #0006; font-weight: 400; font-size: 13px; padding: 5px 10px; }
    #surgsim .steer { opacity: .8; font-size: 14px; margin-top: 10px; max-width: 240px; }`;
  const root = document.createElement("div");
  root.id = "surgsim";
  root.innerHTML = `<style>${style}</style><div class="number"></div><div class="bar"><i></i></div>
    <div class="text"></div><div class="buttons"></div><div class="steer"></div><button class="clip">${CLIP}</button>`;
  const part = (name) => root.querySelector(name);
  addEventListener("DOMContentLoaded", () => document.body.append(root));
  part(".buttons").onclick = ({ target }) => { if (target.dataset.sends) window.surgsim.send(target.dataset.sends); target.blur(); };

  // A clip is a film of the picture, as a file of the browser.
  let film = null;
  part(".clip").onclick = ({ target }) => {
    if (film) { film.stop(); return; }
    film = new MediaRecorder(document.querySelector("canvas").captureStream(30), { mimeType: "video/webm" });
    film.ondataavailable = ({ data }) => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(data);
      link.download = "surgsim.webm";
      link.click();
    };
    film.onstop = () => { film = null; target.textContent = CLIP; };
    film.start();
    target.textContent = "End the clip";
  };

  let level = 0, audio = null;
  const sound = (pitch) => {
    audio ??= new AudioContext();
    const tone = new OscillatorNode(audio, { frequency: pitch }), volume = new GainNode(audio, { gain: 0.15 });
    tone.connect(volume).connect(audio.destination);
    tone.start();
    tone.stop(audio.currentTime + 0.12);
  };
  window.surgsim.show = (state) => {
    const force = Math.max(...state.force), now = (force >= state.soft) + (force >= state.hard);
    const colour = [CALM, AMBER, RED][now];
    part(".number").innerHTML = `${force.toFixed(2)} <small>N</small>`;
    part(".number").style.color = colour;
    part(".bar i").style.background = now ? colour : "#51cf66";
    part(".bar i").style.width = `${Math.min(100, 100 * force / state.hard)}%`;
    // What is replaced under a pressed pointer takes the click with it.
    for (const [name, text] of [[".text", state.text], [".steer", state.steer]])
      if (part(name).textContent !== text) part(name).textContent = text;
    const labels = Object.keys(state.buttons);
    if (labels.join() !== [...part(".buttons").children].map((button) => button.textContent).join())
      part(".buttons").replaceChildren(...labels.map((label) => {
        const button = document.createElement("button");
        button.textContent = label;
        button.dataset.sends = state.buttons[label];
        return button;
      }));
    if (state.tone && now > level) sound(now === 1 ? 660 : 990);
    level = now;
  };

  // In an upright window the panel begins folded: a press on its title, which is the server's label.
  const fold = () => {
    const title = [...document.querySelectorAll("div")].find((one) => !one.childElementCount && one.textContent === "surgsim");
    if (!title) { setTimeout(fold, 200); return; }
    const { x, y } = title.getBoundingClientRect(), where = { clientX: x, clientY: y, bubbles: true, isPrimary: true, pointerId: 1 };
    for (const kind of ["pointerdown", "pointerup"]) title.dispatchEvent(new PointerEvent(kind, { ...where, button: 0 }));
    title.click();
  };
  if (innerWidth < 640) addEventListener("load", fold);

  // viser sees a drag once the pointer has moved: a press that stays where it is becomes one by a step to and fro.
  const STEP = 6;
  addEventListener("pointerdown", (event) => {
    if (event.target.tagName !== "CANVAS" || event.button !== 0 || !event.isTrusted) return;
    const { target, pointerId, pointerType, clientX, clientY, shiftKey } = event;
    for (const step of [STEP, 0])
      setTimeout(() => target.dispatchEvent(new PointerEvent("pointermove", { pointerId, pointerType, shiftKey,
        clientX: clientX + step, clientY, buttons: 1, bubbles: true, cancelable: true, isPrimary: true })), 30 - step);
  }, true);
})();
