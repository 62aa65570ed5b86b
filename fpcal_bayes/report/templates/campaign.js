"use strict";
// Charts that can be zoomed: uPlot draws them; on paper the figures of the page stand instead.
(function () {
  const blue = "#0072B2", vermilion = "#D55E00";
  const data = JSON.parse(document.getElementById("data").textContent);
  const width = function (box) { return Math.max(260, box.clientWidth - 4); };
  const short = function (value) { return value === null || value === undefined ? "" : String(Number(value.toPrecision(4))); };
  const styles = {
    "median": { stroke: blue, width: 1.5 },
    "tolerance": { stroke: vermilion, width: 1.5, dash: [6, 4] }
  };
  const edge = { stroke: "rgba(0,114,178,.5)", width: 0.5 };

  // A vertical line at the present.
  const marks = function (now) {
    return { hooks: { draw: [function (plot) {
      const c = plot.ctx, b = plot.bbox;
      c.save();
      c.beginPath(); c.rect(b.left, b.top, b.width, b.height); c.clip();
      c.setLineDash([4, 4]);
      const line = function (colour, x0, y0, x1, y1) { c.strokeStyle = colour; c.beginPath(); c.moveTo(x0, y0); c.lineTo(x1, y1); c.stroke(); };
      if (now !== null) { const x = plot.valToPos(now, "x", true); line("#000", x, b.top, x, b.top + b.height); }
      c.restore();
    }] } };
  };

  // What the legend says of a series, and at which time where nobody points.
  const said = { "low": "95 % band, from", "high": "to" };
  const order = ["low", "high", "median", "tolerance"];
  const timeChart = function (box, title, hours, series, now, height, logarithmic) {
    const names = order.filter(function (name) { return series[name]; });
    const list = [{ label: "time [h]", value: function (_, v) { return short(v); } }];
    names.forEach(function (name) {
      list.push(Object.assign({ label: said[name] || name, points: { show: false }, value: function (_, v) { return short(v); } }, styles[name] || edge));
    });
    const last = hours.findLastIndex(function (hour) { return now === null || hour <= now + 0.01; });
    const rest = function (plot) { if (plot.cursor.idx === null || plot.cursor.idx === undefined) plot.setLegend({ idx: last }); };
    return new uPlot({
      width: width(box), height: height, series: list, hooks: { ready: [rest], setCursor: [rest] },
      scales: { x: { time: false }, y: { distr: logarithmic ? 3 : 1 } },
      bands: [{ series: [2, 1], fill: "rgba(0,114,178,.15)" }],
      axes: [{ label: "time [h]" }, { label: title, size: 76 }],
      plugins: [marks(now)],
      cursor: { drag: { x: true, y: true, uni: 30 } }
    }, [hours].concat(names.map(function (name) { return series[name]; })), box);
  };

  const boxes = [];
  const place = function (id, make) {
    const part = document.getElementById(id);
    if (!part) return;
    part.classList.add("ready");
    // A curve stands once: on a screen the chart takes the place of the figure before it.
    const before = part.previousElementSibling;
    if (before && before.tagName === "FIGURE") before.classList.add("drawn");
    const box = part.querySelector(".plot");
    const plot = make(box);
    part.querySelector("button").addEventListener("click", function () { plot.setData(plot.data, true); });
    boxes.push(function () { plot.setSize({ width: width(box), height: plot.height }); });
  };

  if (data.outlook) {
    place("chart-outlook", function (box) {
      return timeChart(box, "peak to peak [nm]", data.outlook.hours, data.outlook.series, data.outlook.now, 280, true);
    });
  }
  if (data.residuals) {
    place("chart-residuals", function (box) {
      const names = data.residuals.names, rows = names.map(function (_, i) { return i + 1; });
      return new uPlot({
        width: width(box), height: 260,
        scales: { x: { time: false } },
        series: [
          { label: "row", value: function (_, v) { return v === null ? "" : names[v - 1]; } },
          { label: "residual / sigma", stroke: blue, width: 0, paths: function () { return null; }, points: { show: true, size: 5, fill: blue },
            value: function (_, v) { return short(v); } }
        ],
        axes: [{ label: "row, all sessions in order" }, { label: "residual / sigma", size: 60 }],
        cursor: { drag: { x: true, y: true, uni: 30 } }
      }, [rows, data.residuals.values], box);
    });
  }
  let waiting = 0;
  window.addEventListener("resize", function () {
    window.clearTimeout(waiting);
    waiting = window.setTimeout(function () { boxes.forEach(function (fit) { fit(); }); }, 100);
  });
})();
