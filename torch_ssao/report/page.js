"use strict";
// Untuned, fitted and reference in one picture with two dividers. The pictures lie in the page once, in the list of all
// pictures; here they are shown again by reference. Without this script the section stays hidden and the list is complete.
(() => {
  const section = document.getElementById("compare");
  if (!section) return;
  const stage = section.querySelector(".stage");
  const model = section.querySelector("select");
  const note = section.querySelector(".note");
  const handles = [...section.querySelectorAll(".handle")];
  const cuts = [100 / 3, 200 / 3]; // percent of the width, left <= right
  let held = -1; // the divider that the pointer holds

  const draw = () => {
    stage.style.setProperty("--left", `${cuts[0]}%`);
    stage.style.setProperty("--right", `${cuts[1]}%`);
    handles.forEach((handle, i) => {
      handle.setAttribute("aria-valuenow", Math.round(cuts[i]));
      handle.setAttribute("aria-valuetext", `${Math.round(cuts[i])} % from the left`);
    });
  };

  // A divider pushes the other along: either can reach both edges, so each picture can be seen whole.
  const move = (index, percent) => {
    cuts[index] = Math.min(100, Math.max(0, percent));
    if (index === 0) cuts[1] = Math.max(cuts[1], cuts[0]);
    else cuts[0] = Math.min(cuts[0], cuts[1]);
    draw();
  };

  const at = (event) => {
    const box = stage.getBoundingClientRect();
    return (100 * (event.clientX - box.left)) / box.width;
  };

  const nearest = (percent) => {
    const [left, right] = cuts.map((cut) => Math.abs(percent - cut));
    if (left !== right) return left < right ? 0 : 1;
    return percent < cuts[0] || cuts[0] >= 100 ? 0 : 1;
  };

  stage.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || !event.isPrimary) return;
    held = nearest(at(event));
    stage.setPointerCapture(event.pointerId);
    handles[held].focus({ preventScroll: true });
    move(held, at(event));
    event.preventDefault();
  });
  stage.addEventListener("pointermove", (event) => {
    if (held >= 0 && event.isPrimary) move(held, at(event));
  });
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
    stage.addEventListener(end, () => { held = -1; });
  }

  handles.forEach((handle, index) => {
    handle.addEventListener("keydown", (event) => {
      const steps = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10, Home: -100, End: 100 };
      if (!(event.key in steps) || event.ctrlKey || event.altKey || event.metaKey) return;
      move(index, cuts[index] + steps[event.key]);
      event.preventDefault(); // the page would scroll
    });
  });

  const source = (id) => document.getElementById(`picture-${id}`).src;
  const show = () => {
    const name = model.value;
    for (const state of ["untuned", "fitted"]) {
      stage.querySelector(`.${state} img`).src = source(`${name}_${state}`);
      section.querySelector(`.error.${state} img`).src = source(`${name}_${state}_error`);
    }
    note.textContent = model.selectedOptions[0].dataset.note;
  };

  for (const frame of section.querySelectorAll("[data-alt]")) {
    const image = document.createElement("img");
    image.alt = frame.dataset.alt;
    image.draggable = false;
    frame.prepend(image);
  }
  stage.querySelector(".reference img").src = source("reference");
  model.addEventListener("change", show);
  section.hidden = false;
  show();
  draw();
})();
