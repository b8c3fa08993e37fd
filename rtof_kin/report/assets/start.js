
// Draws all plots and sets data-state of the root element to "ready" or "failed".
window.addEventListener("error", event => {
  document.documentElement.dataset.state = "failed";
  document.documentElement.dataset.error = event.message;
});
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const move = {cursors: () => {}, go: () => {}};
  const time = {x: data.angles.times, label: "time [s]", unit: "s"};
  move.cursors = draw_charts(document.getElementById("angle-charts"), data.angles.groups, time, t => move.go(t));
  const marks = Object.entries(data.cycles.stance).map(([side, share]) => ({side, at: 100 * share}));
  const cycle = {x: data.cycles.phase, label: "gait cycle, from heel strike [%]; dashed: toe off", unit: "%", marks};
  draw_charts(document.getElementById("cycle-charts"), data.cycles.groups, cycle, null);
  move.go = start_player(data.player, t => move.cursors(t));
  // Open all details for printing.
  window.addEventListener("beforeprint", () =>
    document.querySelectorAll("details").forEach(details => { details.open = true; }));
  document.documentElement.dataset.state = "ready";
})();
