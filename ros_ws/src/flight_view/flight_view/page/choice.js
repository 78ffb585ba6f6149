// The charts that the user has chosen, in an order of the user's, and charts of any channels; kept by the browser.
import {channelsOf, chartOf} from "./charts.js";

const KEPT = "charts";
const MOST = 4; // channels of a chart

const $ = id => document.getElementById(id);
let kept = {order: [], hidden: [], added: [], ...JSON.parse(localStorage.getItem(KEPT) ?? "{}")}; // titles, titles, lists of channels
let changed = () => {}, shown = "";

function keep(next) {
  kept = {...kept, ...next};
  localStorage.setItem(KEPT, JSON.stringify(kept));
  shown = "";
  changed();
}

// The charts to draw, of those that the log offers.
export function chosen(flight, offered) {
  const has = channel => flight.get(channel.slice(0, channel.indexOf("/")))?.column(channel.slice(channel.indexOf("/") + 1));
  const all = [...offered, ...kept.added.filter(channels => channels.every(has)).map(channels => chartOf(flight, channels))];
  const place = ({title}) => (kept.order.includes(title) ? kept.order.indexOf(title) : kept.order.length);
  const ordered = all.map((chart, k) => [place(chart), k, chart]).sort((one, next) => one[0] - next[0] || one[1] - next[1]).map(([, , chart]) => chart);
  offer(flight, ordered);
  return ordered.filter(({title}) => !kept.hidden.includes(title));
}

function element(tag, properties, ...children) {
  const node = Object.assign(document.createElement(tag), properties);
  node.append(...children);
  return node;
}

function offer(flight, charts) {
  const titles = charts.map(({title}) => title), channels = channelsOf(flight), now = JSON.stringify([titles, channels]);
  if (shown === now) return;
  shown = now;
  const move = (k, by) => {
    const order = [...titles], [title] = order.splice(k, 1);
    order.splice(k + by, 0, title);
    keep({order});
  };
  $("choice-charts").replaceChildren(...charts.map(({title, channels: own}, k) => {
    const box = element("input", {type: "checkbox", checked: !kept.hidden.includes(title)});
    box.addEventListener("change", () => keep({hidden: box.checked ? kept.hidden.filter(name => name !== title) : [...kept.hidden, title]}));
    const button = (text, about, disabled, action) => {
      const node = element("button", {textContent: text, disabled, title: about});
      node.setAttribute("aria-label", `${about}: ${title}`);
      node.addEventListener("click", action);
      return node;
    };
    const buttons = [button("\u2191", "Up", k === 0, () => move(k, -1)), button("\u2193", "Down", k === charts.length - 1, () => move(k, 1))];
    if (own) buttons.push(button("Remove", "Remove", false, () => keep({added: kept.added.filter(list => list.join() !== own.join())})));
    return element("li", {}, element("label", {}, box, ` ${title}`), element("span", {className: "tools"}, ...buttons));
  }));
  for (const select of document.querySelectorAll("#choice-channels select")) {
    const before = select.value;
    select.replaceChildren(new Option("", ""), ...channels.map(name => new Option(name, name, false, name === before)));
  }
}

// Build the choice; `redraw` is called when another chart is chosen.
export function begin(redraw) {
  changed = redraw;
  const selects = Array.from({length: MOST}, (_, k) => element("select", {ariaLabel: `Channel ${k + 1}`}));
  const add = element("button", {textContent: "Add a chart", id: "choice-add"}), reset = element("button", {textContent: "As at first", id: "choice-reset"});
  add.addEventListener("click", () => {
    const channels = [...new Set(selects.map(select => select.value).filter(Boolean))];
    if (channels.length && !kept.added.some(list => list.join() === channels.join())) keep({added: [...kept.added, channels]});
  });
  reset.addEventListener("click", () => keep({order: [], hidden: [], added: []}));
  $("choice-channels").append(...selects, add, reset);
}
