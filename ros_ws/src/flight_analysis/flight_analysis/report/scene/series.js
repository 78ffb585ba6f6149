// Samples in typed arrays by channel.

const GAP = 0.1; // s, and
const GAP_PERIODS = 5; // periods of a topic, above which two samples have a gap between them
const FIRST = 50; // samples from which the period of a topic is taken

// Index of the last of the first `count` times that is not after `t`; -1 before the first one.
export function indexAt(times, count, t) {
  let low = 0, high = count;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle + 1; else high = middle;
  }
  return low - 1;
}

function grown(array, size) {
  const larger = new array.constructor(Math.max(size, 2 * array.length));
  larger.set(array);
  return larger;
}

export class Series { // the rows of one topic
  constructor(channels) {
    this.channels = channels;
    this.count = 0;
    this.t = new Float64Array(1024); // s
    this.columns = channels.map(() => new Float32Array(1024));
    this.gaps = []; // rows before a gap
    this.longest = Infinity; // s, time without a sample that is no gap
  }

  append(t, columns) {
    const end = this.count + t.length;
    if (end > this.t.length) {
      this.t = grown(this.t, end);
      this.columns = this.columns.map(column => grown(column, end));
    }
    this.t.set(t, this.count);
    columns.forEach((column, k) => this.columns[k].set(column, this.count));
    const seen = this.longest < Infinity ? Math.max(this.count, 1) : 1;
    this.count = end;
    this.takeGaps(seen);
  }

  takeGaps(first) { // between the rows from `first` on and the rows before them
    if (this.longest === Infinity) {
      if (this.count <= FIRST) return;
      const steps = Array.from({length: FIRST}, (_, k) => this.t[k + 1] - this.t[k]).sort((a, b) => a - b);
      this.longest = Math.max(GAP, GAP_PERIODS * steps[FIRST >> 1]);
    }
    for (let k = first; k < this.count; k++) if (this.t[k] - this.t[k - 1] > this.longest) this.gaps.push(k - 1);
  }

  // Whether there is a gap between two rows.
  hasGap(from, to) {
    const next = indexAt(this.gaps, this.gaps.length, from - 0.5) + 1;
    return next < this.gaps.length && this.gaps[next] < to;
  }

  column(channel) { // undefined without such a channel
    return this.columns[this.channels.indexOf(channel)];
  }

  at(channel, t) { // the newest value at a time; NaN without one
    const row = indexAt(this.t, this.count, t), column = this.column(channel);
    return column && row >= 0 ? column[row] : NaN;
  }

  shown(channel, t) { // as `at`; NaN in a gap
    const row = indexAt(this.t, this.count, t);
    return row >= 0 && this.hasGap(row, row + 1) && t > this.t[row] + this.longest ? NaN : this.at(channel, t);
  }

  group(prefix) { // names of the channels "prefix.name"
    return this.channels.filter(channel => channel.startsWith(prefix + ".")).map(channel => channel.slice(prefix.length + 1));
  }
}
