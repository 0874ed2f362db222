// The player. Each trajectory is one video that holds all panels (columns: methods, rows: modalities), so that
// they can never run apart; the panels on the page are crops of it, drawn on canvases.
(function () {
  "use strict";
  var data = JSON.parse(document.getElementById("player-data").textContent);
  if (!data.trajectories.length) { return; }
  document.documentElement.classList.add("js");
  var find = function (id) { return document.getElementById(id); };
  var wall = find("wall"), play = find("play"), scrub = find("scrub"), speed = find("speed"), clock = find("clock");
  var left = find("compare-left"), right = find("compare-right"), modality = find("compare-modality"), wipe = find("wipe");
  var stage = find("compare-canvas"), bar = find("compare-bar");
  var tagLeft = find("tag-left"), tagRight = find("tag-right");
  var still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  var current = null, video = null, panels = [], playing = !still;

  function element(name, className, text) {
    var made = document.createElement(name);
    if (className) { made.className = className; }
    if (text) { made.textContent = text; }
    return made;
  }

  function heading(column) {
    var head = element("div", "head");
    var dot = element("span", "dot");
    dot.style.setProperty("--tone", "var(--" + column + ")");
    head.appendChild(dot);
    head.appendChild(document.createTextNode(data.titles[column] || column));
    return head;
  }

  function build() {
    wall.textContent = "";
    panels = [];
    wall.style.setProperty("--columns", data.columns.length);
    wall.style.setProperty("--aspect", current.width + " / " + current.height);
    wall.appendChild(element("div", "corner"));
    data.columns.forEach(function (column) { wall.appendChild(heading(column)); });
    data.rows.forEach(function (row, y) {
      var somebody = data.columns.some(function (c) { return (current.panels[c] || []).indexOf(row.name) >= 0; });
      if (!somebody) { return; }
      wall.appendChild(element("div", "row", row.title));
      data.columns.forEach(function (column, x) {
        var here = current.panels[column];
        if (!here || here.indexOf(row.name) < 0) {
          var why = column !== "truth" ? "not produced" : row.name === "error" ? "the reference" : "not recorded";
          wall.appendChild(element("div", "none", why));
          return;
        }
        var canvas = element("canvas");
        canvas.width = current.width; canvas.height = current.height;
        canvas.setAttribute("role", "img");
        canvas.setAttribute("aria-label", row.title + ", " + (data.titles[column] || column) + ", " + current.title);
        wall.appendChild(canvas);
        panels.push({ canvas: canvas, x: x, y: y });
      });
    });
  }

  function crop(canvas, x, y, from, to) {
    var w = current.width, h = current.height, a = Math.round(from * w), b = Math.round(to * w);
    if (b > a) {
      canvas.getContext("2d").drawImage(video, x * w + a, y * h, b - a, h, a, 0, b - a, h);
    }
  }

  function draw() {
    if (!video || video.readyState < 2) { return; }
    panels.forEach(function (p) { crop(p.canvas, p.x, p.y, 0, 1); });
    var cut = wipe.value / 100, y = +modality.value;
    if (stage.width !== current.width) {
      stage.width = current.width;
      stage.parentElement.style.maxWidth = "min(70rem, " + (2 * current.width) + "px)"; // not stretched beyond twice its pixels
    }
    if (stage.height !== current.height) { stage.height = current.height; }
    crop(stage, data.columns.indexOf(left.value), y, 0, cut);
    crop(stage, data.columns.indexOf(right.value), y, cut, 1);
    bar.style.left = (100 * cut) + "%";
    tagLeft.textContent = data.titles[left.value];
    tagRight.textContent = data.titles[right.value];
    if (video.duration && document.activeElement !== scrub) { scrub.value = 1000 * video.currentTime / video.duration; }
    var frame = Math.min(current.frames - 1, Math.floor(video.currentTime * data.fps + 0.25));
    clock.textContent = "frame " + (frame + 1) + " of " + current.frames;
  }

  function options(select, wanted) {
    var before = select.value || wanted;
    select.textContent = "";
    data.columns.forEach(function (column) {
      if (!current.panels[column]) { return; }
      var option = element("option", "", data.titles[column]);
      option.value = column;
      select.appendChild(option);
    });
    select.value = current.panels[before] ? before : select.options[0].value;
  }

  function state() {
    play.textContent = playing ? "Pause" : "Play";
    play.setAttribute("aria-pressed", String(playing));
    if (!video) { return; }
    if (playing) { var started = video.play(); if (started) { started.catch(function () { playing = false; state(); }); } }
    else { video.pause(); }
  }

  function choose(name) {
    var next = data.trajectories.filter(function (t) { return t.name === name; })[0];
    var where = video && video.duration ? video.currentTime / video.duration : 0;
    if (video) { video.pause(); }
    current = next;
    video = find("video-" + next.index);
    video.loop = true; video.muted = true; video.playbackRate = +speed.value;
    video.onloadeddata = video.onseeked = draw;
    build(); options(left, "street_gaussians"); options(right, "mudg_s");
    var ready = function () { video.currentTime = where * (video.duration || 0); draw(); state(); };
    if (video.readyState >= 2) { ready(); }
    else { video.addEventListener("loadeddata", ready, { once: true }); video.preload = "auto"; video.load(); }
  }

  function selected(group) {
    var chosen = document.querySelector('input[name="' + group + '"]:checked');
    return chosen ? chosen.value : null;
  }

  function pick() {
    var camera = selected("camera") || data.trajectories[0].camera;
    document.querySelectorAll("#shifts label").forEach(function (label) {
      label.hidden = label.dataset.camera !== camera;
    });
    var wanted = document.querySelector('#shifts label:not([hidden]) input:checked');
    if (!wanted) {
      wanted = document.querySelector('#shifts label:not([hidden]) input');
      wanted.checked = true;
    }
    choose(wanted.value);
  }

  document.querySelectorAll('input[name="camera"], input[name="shift"]').forEach(function (input) {
    input.addEventListener("change", pick);
  });
  play.addEventListener("click", function () { playing = !playing; state(); });
  speed.addEventListener("change", function () { if (video) { video.playbackRate = +speed.value; } });
  scrub.addEventListener("input", function () {
    playing = false; state();
    if (video && video.duration) { video.currentTime = scrub.value / 1000 * video.duration; }
  });
  [left, right, modality, wipe].forEach(function (control) { control.addEventListener("input", draw); });
  (function loop() { if (playing) { draw(); } window.requestAnimationFrame(loop); })();
  pick();
})();
