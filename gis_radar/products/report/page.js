"use strict";
(() => {
  const picture = document.getElementById("picture");
  const slider = document.getElementById("slider");
  const play = document.getElementById("play");
  const whole = { src: picture.src, alt: picture.alt };
  whole.label = document.getElementById("label").textContent;
  whole.text = document.getElementById("text").textContent;
  const frames = [whole];
  for (const figure of document.querySelectorAll(".frames figure")) {
    const image = figure.querySelector("img");
    frames.push({
      src: image.src,
      alt: image.alt,
      label: figure.querySelector("strong").textContent,
      text: figure.querySelector("span").textContent,
    });
  }
  const slow = window.matchMedia("(prefers-reduced-motion: reduce)");
  let timer = 0;

  const show = (index) => {
    const frame = frames[index];
    slider.value = String(index);
    slider.setAttribute("aria-valuetext", frame.label);
    picture.src = frame.src;
    picture.alt = frame.alt;
    document.getElementById("shown").textContent = frame.label;
    document.getElementById("label").textContent = frame.label;
    document.getElementById("text").textContent = frame.text;
    document.getElementById("earlier").disabled = index === 0;
    document.getElementById("later").disabled = index === frames.length - 1;
  };
  const at = () => Number(slider.value);
  const stop = () => {
    window.clearInterval(timer);
    timer = 0;
    play.textContent = play.dataset.play;
    play.setAttribute("aria-pressed", "false");
  };
  const start = () => {
    timer = window.setInterval(
      () => show(at() === frames.length - 1 ? 1 : at() + 1), slow.matches ? 2500 : 900);
    play.textContent = play.dataset.pause;
    play.setAttribute("aria-pressed", "true");
    show(at() === frames.length - 1 ? 1 : at() + 1);
  };

  slider.addEventListener("input", () => { stop(); show(at()); });
  play.addEventListener("click", () => (timer ? stop() : start()));
  document.getElementById("earlier").addEventListener("click", () => { stop(); show(Math.max(at() - 1, 0)); });
  document.getElementById("later").addEventListener("click", () => { stop(); show(Math.min(at() + 1, frames.length - 1)); });
  document.getElementById("reset").addEventListener("click", () => { stop(); show(0); });
  // On paper the large map shows the whole time, whatever the slider shows.
  let before = 0;
  window.addEventListener("beforeprint", () => { stop(); before = at(); show(0); });
  window.addEventListener("afterprint", () => show(before));
  document.getElementById("controls").hidden = false;
  show(0);
})();
