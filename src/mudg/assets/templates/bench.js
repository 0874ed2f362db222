// Shows the video of the chosen log and lateral shift.
(function () {
  "use strict";
  var log = document.getElementById("log"), shift = document.getElementById("shift");
  if (!log) { return; }
  function show() {
    document.querySelectorAll(".film").forEach(function (film) {
      var chosen = film.dataset.log === log.value && film.dataset.shift === shift.value, video = film.querySelector("video");
      film.classList.toggle("hidden", !chosen);
      if (chosen) { video.play().catch(function () {}); } else { video.pause(); }
    });
  }
  document.getElementById("choices").classList.remove("hidden");
  log.onchange = shift.onchange = show;
  show();
})();
