for (const figure of document.querySelectorAll(".compare")) {
  const slider = figure.querySelector("input"), stage = figure.querySelector(".stage");
  const show = () => figure.style.setProperty("--at", slider.value + "%");
  const follow = event => {
    const box = stage.getBoundingClientRect();
    slider.value = 100 * (event.clientX - box.left) / box.width;
    show();
  };
  figure.classList.add("live");
  slider.addEventListener("input", show);
  stage.addEventListener("pointerdown", event => { stage.setPointerCapture(event.pointerId); follow(event); event.preventDefault(); });
  stage.addEventListener("pointermove", event => { if (stage.hasPointerCapture(event.pointerId)) follow(event); });
  show();
}
