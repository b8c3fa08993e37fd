
// Draws all charts and sets data-state of the root element to "ready" or "failed".
window.addEventListener("error", event => {
  document.documentElement.dataset.state = "failed";
  document.documentElement.dataset.error = event.message;
});
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const labels = {
    time: {label: "time on A's clock [s]", unit: "s"},
    cycle: {label: "gait cycle, from heel strike [%]", unit: "%"},
    repetition: {label: "repetition [%]", unit: "%"},
  };
  const parent = document.getElementById("curve-charts");
  if (data.groups.length) draw_charts(parent, data.groups, {x: data.x, marks: [], ...labels[data.by]}, null);
  document.documentElement.dataset.state = "ready";
})();
