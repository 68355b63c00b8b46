"use strict";
// Moving pictures. A panel has one picture with all its frames below each other; a player draws the same frame of all
// its panels. Two of them share a stage: the left one covers the right one up to a line that is dragged.
for (const player of document.querySelectorAll(".player")) {
  const count = Number(player.dataset.frames), panels = [...player.querySelectorAll("figure[data-strip]")];
  const find = selector => player.querySelector(selector);
  const slider = find("input.frame"), label = find("output"), play = find("button.play"), stage = find(".stage");
  const reveal = find("input.reveal"), magnify = find("select.magnify"), [left, right] = [find("select.left"), find("select.right")];
  let frame = 0, timer = null;
  const strips = panels.map(panel => { const image = new Image(); image.onload = draw; image.src = panel.dataset.strip; return image; });

  function paint(canvas, image) {
    if (!image.complete || !image.naturalWidth) return;
    const height = image.naturalHeight / count;
    if (canvas.width !== image.naturalWidth || canvas.height !== height) { canvas.width = image.naturalWidth; canvas.height = height; }
    canvas.getContext("2d").drawImage(image, 0, frame * height, image.naturalWidth, height, 0, 0, image.naturalWidth, height);
  }
  function side(name, chosen) {
    const canvas = stage.querySelector("canvas." + name), caption = panels[chosen].querySelector("figcaption").textContent;
    paint(canvas, strips[chosen]);
    canvas.setAttribute("aria-label", name + ": " + caption);
    stage.querySelector(".name." + name).textContent = caption;
  }
  function draw() {
    panels.forEach((panel, i) => paint(panel.querySelector("canvas"), strips[i]));
    label.textContent = "frame " + (frame + 1) + " / " + count;
    slider.value = frame;
    side("right", Number(right.value));
    side("left", Number(left.value));
    stage.style.setProperty("--share", reveal.value + "%");
    stage.style.setProperty("--scale", magnify.value);
  }
  function go(to) { frame = (to + count) % count; draw(); }
  function toggle() {
    if (timer) { clearInterval(timer); timer = null; } else { timer = setInterval(() => go(frame + 1), Number(player.dataset.milliseconds)); }
    play.textContent = timer ? "pause" : "play";
    play.setAttribute("aria-pressed", String(Boolean(timer)));
  }
  function point(event) {  // the line follows a pressed pointer; the magnified part follows any pointer
    const box = stage.getBoundingClientRect(), across = x => Math.min(Math.max(x, 0), 100);
    const x = across(100 * (event.clientX - box.left) / box.width), y = across(100 * (event.clientY - box.top) / box.height);
    stage.style.setProperty("--x", x + "%");
    stage.style.setProperty("--y", y + "%");
    if (event.buttons) { reveal.value = x; draw(); }
  }
  stage.addEventListener("pointerdown", event => { stage.setPointerCapture(event.pointerId); point(event); });
  stage.addEventListener("pointermove", point);
  panels.forEach((panel, i) => panel.querySelector("canvas").addEventListener("click", () => {
    right.value = i;
    draw();
    stage.scrollIntoView({ block: "nearest", behavior: matchMedia("(prefers-reduced-motion: reduce)").matches ? "auto" : "smooth" });
  }));
  play.addEventListener("click", toggle);
  slider.addEventListener("input", () => go(Number(slider.value)));
  for (const control of [reveal, magnify, left, right]) control.addEventListener("input", draw);
  player.addEventListener("keydown", event => {
    if (["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName)) return;
    const steps = { ArrowRight: frame + 1, ArrowLeft: frame - 1, Home: 0, End: count - 1 };
    if (event.key in steps) go(steps[event.key]); else if (event.key === " ") toggle(); else return;
    event.preventDefault();
  });
  draw();
}

// The contents mark the section in view.
const links = [...document.querySelectorAll("nav.contents a")];
const seen = new IntersectionObserver(entries => {
  for (const entry of entries) {
    if (!entry.isIntersecting) continue;
    for (const link of links) {
      const here = link.hash === "#" + entry.target.id;
      if (here) link.setAttribute("aria-current", "true"); else link.removeAttribute("aria-current");
      if (here) link.parentElement.parentElement.scrollTo({ left: link.offsetLeft - 20 });
    }
  }
}, { rootMargin: "-15% 0px -75% 0px" });
document.querySelectorAll("main section[id]").forEach(section => seen.observe(section));
