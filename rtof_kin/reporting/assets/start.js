
// Draws all plots and sets data-state of the root element to "ready" or "failed".
window.addEventListener("error", event => {
  document.documentElement.dataset.state = "failed";
  document.documentElement.dataset.error = event.message;
});

// Groups of curves; an angle that OpenSim counts the other way round has a second chart for its convention.
function conventions(groups) {
  return groups.flatMap(group => {
    if (!group.opposite) return [group];
    const shown = group.shown.split(" ").filter(name => name !== "opensim").join(" ");
    const other = {...group, name: group.opensim, positive: "opposite to the clinical angle", turned: true, shown: "opensim"};
    return [{...group, shown}, other];
  });
}

// Printing: what is folded is left out, unless it was asked for.
function start_printing() {
  const all = document.getElementById("print-all");
  let opened = [];
  all.checked = location.hash === "#print-all";
  document.getElementById("print").addEventListener("click", () => window.print());
  window.addEventListener("beforeprint", () => {
    opened = all.checked ? [...document.querySelectorAll("details:not([open])")] : [];
    for (const details of opened) details.open = true;
  });
  window.addEventListener("afterprint", () => { for (const details of opened) details.open = false; });
}

(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const move = {cursors: () => {}, go: () => {}};
  const time = {x: data.angles.times, label: "time [s]", unit: "s"};
  const draw = (id, groups, axis, go) => draw_charts(document.getElementById(id), conventions(groups), axis, go);
  move.cursors = draw("angle-charts", data.angles.groups, time, t => move.go(t));
  const marks = Object.entries(data.cycles.stance).map(([side, share]) => ({side, at: 100 * share}));
  const cycle = {x: data.cycles.phase, label: "gait cycle, from heel strike [%]; dashed: toe off", unit: "%", marks};
  draw("cycle-charts", data.cycles.groups, cycle, null);
  move.go = start_player(data.player, (t, read) => move.cursors(t, read));
  const convention = document.getElementById("convention");
  convention.addEventListener("change", () => { document.documentElement.dataset.angles = convention.value; });
  start_printing();
  document.documentElement.dataset.state = "ready";
})();
