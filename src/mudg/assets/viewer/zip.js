// A ZIP archive of files that are compressed already.

const TABLE = Uint32Array.from({ length: 256 }, (_, n) => { let c = n; for (let k = 0; k < 8; k++) c = c & 1 ? 0xedb88320 ^ (c >>> 1) : c >>> 1; return c; });

/** The checksum of the format. */
export function crc32(bytes) {
  let c = 0xffffffff;
  for (let i = 0; i < bytes.length; i++) c = TABLE[(c ^ bytes[i]) & 255] ^ (c >>> 8);
  return (c ^ 0xffffffff) >>> 0;
}

const NOON = 12 << 11, DAY = (1 << 5) | 1; // of the first of January 1980: the files have no date of their own
const MOST_BYTES = 0xffffffff;

function record(fields) { // [bytes, value] each
  const size = fields.reduce((sum, [bytes]) => sum + bytes, 0), view = new DataView(new ArrayBuffer(size));
  let at = 0;
  for (const [bytes, value] of fields) { if (bytes === 4) view.setUint32(at, value, true); else view.setUint16(at, value, true); at += bytes; }
  return new Uint8Array(view.buffer);
}

/** An archive. @param files [{name, blob}]; at most 4 GB and 65,535 of them. */
export async function zipOf(files) {
  const parts = [], directory = [];
  let at = 0;
  for (const { name, blob } of files) {
    const title = new TextEncoder().encode(name), content = new Uint8Array(await blob.arrayBuffer());
    const about = [[2, 20], [2, 0x800], [2, 0], [2, NOON], [2, DAY], [4, crc32(content)], [4, content.length], [4, content.length], [2, title.length], [2, 0]];
    const head = record([[4, 0x04034b50], ...about]);
    directory.push(record([[4, 0x02014b50], [2, 20], ...about, [2, 0], [2, 0], [2, 0], [4, 0], [4, at]]), title);
    parts.push(head, title, blob);
    at += head.length + title.length + content.length;
    if (at > MOST_BYTES || files.length > 65535) throw new Error("too much for one archive");
  }
  const size = directory.reduce((sum, part) => sum + part.length, 0);
  return new Blob([...parts, ...directory, record([[4, 0x06054b50], [2, 0], [2, 0], [2, files.length], [2, files.length], [4, size], [4, at], [2, 0]])], { type: "application/zip" });
}
