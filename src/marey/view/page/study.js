// The page of a study: the lines of the table of trials that contain a text.
"use strict";

document.getElementById("find").addEventListener("input", event => {
  const wanted = event.target.value.trim().toLowerCase();
  for (const row of document.querySelectorAll(".trials tbody tr")) {
    row.hidden = !row.textContent.toLowerCase().includes(wanted);
  }
});
