// Samples in typed arrays by channel.

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
  }

  append(t, columns) {
    const end = this.count + t.length;
    if (end > this.t.length) {
      this.t = grown(this.t, end);
      this.columns = this.columns.map(column => grown(column, end));
    }
    this.t.set(t, this.count);
    columns.forEach((column, k) => this.columns[k].set(column, this.count));
    this.count = end;
  }

  column(channel) { // undefined without such a channel
    return this.columns[this.channels.indexOf(channel)];
  }

  at(channel, t) { // the newest value at a time; NaN without one
    const row = indexAt(this.t, this.count, t), column = this.column(channel);
    return column && row >= 0 ? column[row] : NaN;
  }

  group(prefix) { // names of the channels "prefix.name"
    return this.channels.filter(channel => channel.startsWith(prefix + ".")).map(channel => channel.slice(prefix.length + 1));
  }
}
