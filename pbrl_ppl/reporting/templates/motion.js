// Plays held-out motions: what was measured, filled, and what a model predicted, outlined.
"use strict";
(function () {
  const source = document.getElementById("motion-data");
  if (!source) return;
  const data = JSON.parse(source.textContent);
  const SVG = "http://www.w3.org/2000/svg";
  const make = (name, attributes, parent) => {
    const element = document.createElementNS(SVG, name);
    for (const key in attributes) element.setAttribute(key, attributes[key]);
    if (parent) parent.appendChild(element);
    return element;
  };
  const byId = (id) => document.getElementById(id);
  const play = byId("play"), scrub = byId("scrub"), clock = byId("clock"), pick = byId("pick");
  const still = window.matchMedia("(prefers-reduced-motion: reduce)");
  const shape = (body, attributes, parent) => {
    const group = make("g", attributes, parent);
    let reach;
    if (body.outline) {
      make("polygon", { points: body.outline.map((p) => p.join(",")).join(" ") }, group);
      reach = Math.max(...body.outline.map((p) => p[0]));
    } else {
      make("circle", { r: body.radius }, group);
      reach = body.radius;
    }
    make("line", { x1: 0, y1: 0, x2: reach, y2: 0 }, group); // which way it faces
    return group;
  };
  const place = (group, pose) => {
    const seen = pose && pose.every((value) => value !== null);
    group.style.display = seen ? "" : "none";
    if (seen) group.setAttribute("transform",
      `translate(${pose[0]} ${pose[1]}) rotate(${pose[2] * 180 / Math.PI})`);
  };
  const stages = data.models.map((model, number) => {
    const svg = byId("stage-" + model);
    const world = make("g", { transform: "scale(1 -1)" }, svg);
    for (const wall of data.walls)
      make("line", { class: "wall", x1: wall[0][0], y1: wall[0][1], x2: wall[1][0], y2: wall[1][1] }, world);
    for (const body of data.static) place(shape(body, { class: "static" }, world), body.pose);
    return {
      model,
      number,
      svg,
      trails: data.bodies.map(() => [
        make("polyline", { class: "trail measured" }, world),
        make("polyline", { class: "trail " + model }, world)]),
      measured: data.bodies.map((body) => shape(body, { class: "measured" }, world)),
      predicted: data.bodies.map((body) => shape(body, { class: model }, world)),
      off: byId("off-" + model),
    };
  });
  let motion, now = 0, timer = null, last = 0;
  // seconds of the motion in a second: the whole lasts 1 to 60 s
  const pace = () => end() / Math.min(60, Math.max(1, end())) || 1;
  const seconds = (time) =>
    time.toFixed(Math.min(20, Math.max(0, 2 - Math.floor(Math.log10(end() || 1)))));
  const turn = (a) => Math.atan2(Math.sin(a), Math.cos(a));
  // between two rows, so that slow recordings move smoothly too
  const at = (rows, time) => {
    const times = motion.time;
    let i = 0;
    while (i < times.length - 2 && times[i + 1] <= time) i++;
    const j = Math.min(i + 1, times.length - 1);
    const share = j > i ? Math.min(1, Math.max(0, (time - times[i]) / (times[j] - times[i]))) : 0;
    return rows[i].map((first, b) => {
      const second = rows[j][b];
      if (first.includes(null) || second.includes(null)) return share < 0.5 ? first : second;
      return [first[0] + share * (second[0] - first[0]), first[1] + share * (second[1] - first[1]),
        first[2] + share * turn(second[2] - first[2])];
    });
  };
  const trail = (rows, b, time) => motion.time
    .map((t, i) => (t <= time && rows[i][b][0] !== null ? rows[i][b].slice(0, 2).join(",") : ""))
    .filter(Boolean).join(" ");
  const draw = () => {
    const measured = at(motion.measured, now);
    for (const stage of stages) {
      const predicted = at(motion[stage.model], now);
      const diverged = predicted.some((pose) => pose.includes(null));
      let far = 0, turned = 0, compared = 0;
      data.bodies.forEach((body, b) => {
        place(stage.measured[b], measured[b]);
        place(stage.predicted[b], predicted[b]);
        stage.trails[b][0].setAttribute("points", trail(motion.measured, b, now));
        stage.trails[b][1].setAttribute("points", trail(motion[stage.model], b, now));
        if (measured[b].includes(null) || predicted[b].includes(null)) return;
        compared += 1;
        far = Math.max(far, Math.hypot(predicted[b][0] - measured[b][0], predicted[b][1] - measured[b][1]));
        turned = Math.max(turned, Math.abs(turn(predicted[b][2] - measured[b][2])) * 180 / Math.PI);
      });
      stage.off.textContent = diverged ? `diverged after ${seconds(motion.diverged[stage.number])} s`
        : compared ? `off by ${far.toPrecision(3)} m and ${turned.toFixed(1)}°` : "nothing measured here";
    }
    scrub.value = now;
    scrub.setAttribute("aria-valuetext", seconds(now) + " seconds");
    const slower = pace() === 1 ? "" : `, at ${pace().toPrecision(3)} times the real speed`;
    clock.textContent = `${seconds(now)} s of ${seconds(end())} s${slower}`;
  };
  const end = () => motion.time[motion.time.length - 1];
  const stop = () => {
    if (timer !== null) cancelAnimationFrame(timer);
    timer = null;
    play.textContent = "Play";
    play.setAttribute("aria-pressed", "false");
  };
  const frame = (stamp) => {
    if (!still.matches) {
      now = Math.min(end(), now + pace() * (stamp - last) / 1000);
      last = stamp;
    } else if (stamp - last > 700) { // one still picture after another
      const next = motion.time.find((t) => t >= now + end() / 12);
      now = next === undefined ? end() : next;
      last = stamp;
    }
    draw();
    if (now >= end()) stop(); else timer = requestAnimationFrame(frame);
  };
  play.addEventListener("click", () => {
    if (timer !== null) return stop();
    if (now >= end()) now = 0;
    play.textContent = "Pause";
    play.setAttribute("aria-pressed", "true");
    last = performance.now();
    timer = requestAnimationFrame(frame);
  });
  scrub.addEventListener("input", () => { stop(); now = Number(scrub.value); draw(); });
  const choose = () => {
    stop();
    motion = data.motions[pick ? pick.selectedIndex : 0];
    now = 0;
    const [low, high] = motion.box;
    for (const stage of stages)
      stage.svg.setAttribute("viewBox", `${low[0]} ${-high[1]} ${high[0] - low[0]} ${high[1] - low[1]}`);
    scrub.max = end();
    scrub.step = motion.time.length > 1 ? motion.time[1] - motion.time[0] : 0.1;
    draw();
  };
  if (pick) pick.addEventListener("change", choose);
  byId("motion").hidden = false;
  choose();
  now = end(); // how it ended says most in a still picture
  draw();
})();
// what is folded away is printed all the same
window.addEventListener("beforeprint", () =>
  document.querySelectorAll("details").forEach((each) => { each.open = true; }));
