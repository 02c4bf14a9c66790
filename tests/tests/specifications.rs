//! docs/protocol.md and docs/flash-layout.md are true: their golden bytes are what the code makes and takes,
//! their tables alone are enough to decode every message, and no number in them is unchecked.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::iter::from_fn;
use std::ops::Range;
use std::path::Path;

use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};
use firmware_core::capacity::{MAX_INPUTS, MAX_STATES};
use firmware_core::control_loop::telemetry::Queue;
use firmware_core::control_loop::{
    Alarms, Command, ControlLoop, Frame, Mode, Supervisor, Telemetry, Timing,
};
use firmware_core::link::{MAX_FRAME, Message, Port, Received, Receiver, encode};
use firmware_core::slots::{
    Boot, Geometry, MAX_WRITE_SIZE, PAYLOAD_OFFSET, Payload, Refusal, Release, Slots, VERSION,
    Which, robot, sha256,
};
use firmware_core::update::{
    Answer, Answers, Ask, Capacities, Hello, Identity, MAX_CHUNK, NoUpdates, PROTOCOL, PublicKey,
    Purpose, Refused, Request, SIGNATURE, SIGNATURE_PAUSE_US, SILENCE_US, Say, Signature, Trial,
    Trust, Updater, Updates, statement,
};
use firmware_sim::mcu::uart::UartSettings;
use serde_json::{Map, Value};

/// Secret key of RFC 8032, section 7.1, test 1.
const SECRET: &str = "9d61b19deffd5a60ba844af492ec2cc44449c5697b326919703bac031cae7f60";
/// Its public key.
const PUBLIC: &str = "d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a";
const ROBOT: &str = "rosbot";
const BLOB: &[u8] = b"koopman";
const SEQUENCE: u32 = 7;

/// What external standards call things, and other words with digits that say nothing of the code.
const WORDS: &[&str] = &[
    "8N1",
    "8032",
    "5.1.7",
    "CRC-32",
    "CRC-32/ISO-HDLC",
    "SHA-256",
    "Ed25519",
    "UTF-8",
    "754",
    "u16",
    "u32",
    "u64",
    "f32",
    "FF",
    "0x04C11DB7",
    "0xEDB88320",
    "0xFFFFFFFF",
    "254",
    "123456789",
    "sha256",
];

/// A page, and which parts of it have been compared with the code.
struct Page {
    text: String,
    checked: Vec<Range<usize>>,
    wrong: Vec<String>,
}

impl Page {
    fn read(name: &str) -> Self {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs").join(name);
        let text = std::fs::read_to_string(path).unwrap();
        Self { text, checked: Vec::new(), wrong: Vec::new() }
    }

    /// The page has these words, wherever its lines end.
    fn holds(&mut self, words: &str) {
        let mut found = false;
        let mut from = 0;
        let words: Vec<&str> = words.split_whitespace().collect();
        while let Some(at) = self.text[from..].find(words[0]).map(|at| from + at) {
            let mut end = at;
            let all = words.iter().enumerate().all(|(i, word)| {
                let rest = &self.text[end..];
                let space = rest.len() - rest.trim_start().len();
                let next = rest.trim_start().starts_with(word) && (i == 0 || space > 0);
                end += space + word.len();
                next
            });
            // A number goes on: 1 is not in 10.
            let cut = |c: Option<char>| c.is_some_and(|c| c.is_ascii_digit());
            let (before, after) = (self.text[..at].chars().next_back(), end.min(self.text.len()));
            let whole = |word: &str, c| !(word.ends_with(|c: char| c.is_ascii_digit()) && cut(c));
            let begins = !(words[0].starts_with(|c: char| c.is_ascii_digit()) && cut(before));
            if all && begins && whole(words[words.len() - 1], self.text[after..].chars().next()) {
                self.checked.push(at..end);
                found = true;
            }
            from = at + words[0].len();
        }
        if !found {
            self.wrong.push(format!("the page does not say: {}", words.join(" ")));
        }
    }

    /// The golden block of this name is this.
    fn golden(&mut self, name: &str, lines: &str) {
        if self.block(name).as_deref() != Some(lines) {
            self.wrong.push(format!("expected\n```golden {name}\n{lines}```\n"));
        }
    }

    /// Names of all golden blocks.
    fn blocks(&self) -> Vec<String> {
        let fences = self.text.lines().filter_map(|line| line.strip_prefix("```golden "));
        fences.map(str::to_owned).collect()
    }

    fn block(&mut self, name: &str) -> Option<String> {
        let fence = format!("```golden {name}\n");
        let begin = self.text.find(&fence)? + fence.len();
        let end = begin + self.text[begin..].find("```")?;
        self.checked.push(begin - fence.len()..end);
        Some(self.text[begin..end].to_owned())
    }

    /// Rows of the table below this heading row, each cell trimmed.
    fn table(&mut self, heading: &str) -> Vec<Vec<String>> {
        let begin = self.text.find(heading).unwrap_or_else(|| panic!("no table {heading}"));
        let rows = self.text[begin..].lines().skip(2).take_while(|line| line.starts_with('|'));
        rows.map(cells).collect()
    }

    /// All is checked, each number too.
    fn finish(mut self) {
        let mut at = 0;
        for line in self.text.split_inclusive('\n') {
            let number = line.trim_start().split_once(". ").map_or("", |(number, _)| number);
            // The number of a step.
            if number.chars().all(|c| c.is_ascii_digit()) {
                let end = at + line.len() - line.trim_start().len() + number.len();
                self.checked.push(at..end);
            }
            at += line.len();
        }
        let is_checked = |at| self.checked.iter().any(|range| range.contains(&at));
        let mut wrong = self.wrong;
        let digits = self.text.char_indices().filter(|(_, c)| c.is_ascii_digit());
        let mut words = BTreeSet::new();
        for (at, _) in digits.filter(|(at, _)| !is_checked(*at)) {
            let splits = |c: char| c.is_whitespace() || "|()`*,;:[]≤+".contains(c);
            let begin = self.text[..at]
                .rfind(splits)
                .map_or(0, |i| i + self.text[i..].chars().next().unwrap().len_utf8());
            let end = self.text[at..].find(splits).map_or(self.text.len(), |end| at + end);
            let word = self.text[begin..end].trim_matches(['.', '-']);
            if !WORDS.contains(&word) {
                let line = self.text[..at].lines().count();
                words.insert(format!("line {line}: nothing checks “{word}”"));
            }
        }
        wrong.extend(words);
        assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
    }
}

/// Cells of a table's row, without the marks of code and links.
fn cells(row: &str) -> Vec<String> {
    let row = row.trim().trim_start_matches('|').trim_end_matches('|');
    row.split('|').map(|cell| cell.trim().trim_matches('`').to_owned()).collect()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn unhex(text: &str) -> Vec<u8> {
    let digits: Vec<char> = text.chars().filter(|c| !c.is_whitespace()).collect();
    let byte = |pair: &[char]| u8::from_str_radix(&pair.iter().collect::<String>(), 16).unwrap();
    digits.chunks(2).map(byte).collect()
}

/// CRC-32/ISO-HDLC, bit by bit.
fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32, _| (crc >> 1) ^ if crc & 1 == 1 { 0xEDB8_8320 } else { 0 };
    !bytes.iter().fold(u32::MAX, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), step))
}

/// COBS as the page has it.
fn stuff(bytes: &[u8]) -> Vec<u8> {
    let runs = bytes.split(|byte| *byte == 0);
    let stuffed = runs.flat_map(|run| {
        let code = u8::try_from(run.len() + 1).unwrap();
        assert!(code < 0xFF, "no message is so long");
        [&[code], run].concat()
    });
    stuffed.chain([0]).collect()
}

/// A frame with this body.
fn framed(body: &[u8]) -> Vec<u8> {
    stuff(&[body, &crc32(body).to_le_bytes()].concat())
}

fn encoded(message: &Message) -> Vec<u8> {
    let mut out = [0; MAX_FRAME];
    let length = encode(message, &mut out).unwrap();
    out[..length].to_vec()
}

fn received(bytes: &[u8]) -> Vec<Received> {
    let mut receiver = Receiver::new();
    bytes.iter().filter_map(|byte| receiver.push(*byte)).collect()
}

/// What is between COBS and CRC-32.
fn body(frame: &[u8]) -> Vec<u8> {
    let (end, mut rest) = frame.split_last().unwrap();
    assert_eq!(*end, 0);
    let mut plain = Vec::new();
    while let Some((code, after)) = rest.split_first() {
        let (run, after) = after.split_at(usize::from(*code) - 1);
        plain.extend(run);
        plain.extend((!after.is_empty()).then_some(0));
        rest = after;
    }
    let (body, check) = plain.split_last_chunk::<4>().unwrap();
    assert_eq!(crc32(body).to_le_bytes(), *check);
    body.to_vec()
}

fn release() -> Release {
    Release::new(ROBOT, SEQUENCE, BLOB).unwrap()
}

fn keys() -> ed25519_compact::KeyPair {
    let seed = ed25519_compact::Seed::from_slice(&unhex(SECRET)).unwrap();
    ed25519_compact::KeyPair::from_seed(seed)
}

fn signed(purpose: Purpose) -> Signature {
    let signature = keys().sk.sign(statement(purpose, &release()), None);
    signature.iter().copied().collect()
}

fn public() -> PublicKey {
    PublicKey(unhex(PUBLIC).try_into().unwrap())
}

fn request(number: u8, ask: Ask) -> Message {
    Message::Request(Request { number, ask })
}

fn answer(number: u8, say: Say) -> Message {
    Message::Answer(Answer { number, say })
}

fn refused(number: u8, refused: Refused) -> Message {
    answer(number, Say::Refused(refused))
}

const SESSION: u32 = 0x1234_5678;

fn begin() -> Ask {
    let signature = signed(Purpose::Install);
    Ask::Begin { session: SESSION, release: release(), signature }
}

fn chunk() -> Ask {
    Ask::Chunk { session: SESSION, offset: 0, bytes: BLOB.iter().copied().collect() }
}

fn verify() -> Ask {
    Ask::Verify { session: SESSION }
}

fn activate() -> Ask {
    Ask::Activate { session: SESSION, signature: signed(Purpose::Activate) }
}

fn confirm() -> Ask {
    Ask::Confirm { signature: signed(Purpose::Confirm) }
}

fn abort() -> Ask {
    Ask::Abort { session: SESSION, signature: signed(Purpose::Abort) }
}

fn hello() -> Hello {
    let text = |text: &str| text.chars().collect();
    Hello {
        protocol: PROTOCOL,
        firmware: text("example 1.0"),
        name: text(ROBOT),
        robot: robot(ROBOT),
        mode: Mode::Idle,
        capacities: Capacities {
            sample_us: 100_000,
            states: 3,
            inputs: 2,
            room: 16_064,
            instructions: 400_000,
            lag: 6,
            observables: 64,
            blocks: 64,
            factors: 96,
            terms: 4096,
            sparse_terms: 255,
        },
        which: Which::B,
        release: release(),
        trial: Some(Trial { good: 12, needed: 1000 }),
        floor: 5,
        key: public().key(),
    }
}

fn frame() -> Frame {
    let list = |numbers: &[f32]| numbers.iter().copied().collect();
    Frame {
        sequence: 300,
        time_us: 5_000_000_000,
        mode: Mode::Running,
        alarms: Alarms::RESIDUAL | Alarms::OUT_OF_RANGE,
        noticed: Alarms::RESIDUAL,
        applied: [12.0, -7.5].into_iter().collect(),
        measured: list(&[0.5, -0.25, 3.0]),
        predicted: list(&[0.5, -0.5, 3.125]),
        residual: list(&[0.0, 0.25, -0.125]),
        steps: 1,
        bound_steps: 10,
        ahead: list(&[1.5, -0.75, 2.5]),
        worst_tick_us: 180,
        dropped: 2,
    }
}

/// The golden messages, by name.
fn golden() -> Vec<(&'static str, Message)> {
    let inputs = Message::Inputs([12.0, -7.5].into_iter().collect());
    let factory = Hello {
        which: Which::Factory,
        mode: Mode::Running,
        release: Release { sequence: 0, ..release() },
        trial: None,
        floor: 0,
        key: None,
        ..hello()
    };
    let empty = Frame { sequence: 1, time_us: 200_000, ..Frame::default() };
    vec![
        ("start", Message::Start),
        ("stop", Message::Stop),
        ("reset", Message::Reset),
        ("inputs", inputs),
        ("frame", Message::Frame(frame())),
        ("frame-at-rest", Message::Frame(empty)),
        ("hello", request(1, Ask::Hello)),
        ("begin", request(2, begin())),
        ("chunk", request(3, chunk())),
        ("verify", request(4, verify())),
        ("activate", request(5, activate())),
        ("confirm", request(6, confirm())),
        ("abort", request(7, abort())),
        ("hello-on-trial", answer(1, Say::Hello(hello()))),
        ("hello-factory", answer(1, Say::Hello(factory))),
        ("working", answer(2, Say::Working { most_ms: 8_000 })),
        ("begun", answer(2, Say::Begun { written: 0 })),
        ("written", answer(3, Say::Written { written: 7 })),
        ("verified", answer(4, Say::Verified)),
        ("activated", answer(5, Say::Activated)),
        ("confirmed", answer(6, Say::Confirmed)),
        ("aborted", answer(7, Say::Aborted)),
        ("unknown", refused(9, Refused::Unknown { variant: 5 })),
        ("too-early", refused(6, Refused::TooEarly { good: 12, needed: 1000 })),
        ("out-of-order", refused(3, Refused::OutOfOrder { written: 7 })),
    ]
}

/// One of each variant besides the golden ones.
fn others() -> Vec<Message> {
    let all = [
        Refused::TooLong { most: 256 },
        Refused::Busy,
        Refused::Working,
        Refused::Signature,
        Refused::Pause { ms: 700 },
        Refused::AnotherRobot { robot: 0x6B9E_3F84 },
        Refused::BelowFloor { floor: 9 },
        Refused::Length { room: 16_064 },
        Refused::OnTrial,
        Refused::InUse,
        Refused::NoSession,
        Refused::Incomplete { written: 192 },
        Refused::Hash,
        Refused::Model,
        Refused::NotVerified,
        Refused::NotOnTrial,
        Refused::Flash,
    ];
    let frame = Frame { mode: Mode::Safe, ..frame() };
    let hello = Hello { which: Which::A, ..hello() };
    let more = [Message::Frame(frame), answer(1, Say::Hello(hello))];
    all.map(|why| refused(1, why)).into_iter().chain(more).collect()
}

/// A message as JSON, byte strings in hex.
fn json(message: &Message) -> String {
    let mut text = serde_json::to_string(message).unwrap();
    for field in ["sha256", "signature", "bytes", "key"] {
        let name = format!("\"{field}\":[");
        while let Some(at) = text.find(&name) {
            let begin = at + name.len() - 1;
            let end = begin + text[begin..].find(']').unwrap() + 1;
            let bytes: Vec<u8> = serde_json::from_str(&text[begin..end]).unwrap();
            text.replace_range(begin..end, &format!("\"{}\"", hex(&bytes)));
        }
    }
    text.replace(',', ", ").replace(':', ": ")
}

/// Words in lines that are not too long, under a heading.
fn lines(heading: &str, words: impl Iterator<Item = String>, width: usize) -> String {
    let mut text = String::new();
    let mut line = format!("{heading:9}");
    for word in words {
        if line.len() + word.len() > width && line.len() > 9 {
            text += line.trim_end();
            text += "\n";
            line = " ".repeat(9);
        }
        line += &word;
        line += " ";
    }
    text + line.trim_end() + "\n"
}

fn block(message: &Message) -> String {
    let bytes =
        |heading, bytes: &[u8]| lines(heading, bytes.iter().map(|b| format!("{b:02x}")), 105);
    let frame = encoded(message);
    let body = body(&frame);
    let json = json(message);
    let words = lines("message", json.split(' ').map(str::to_owned), 105);
    let check = bytes("check", &crc32(&body).to_le_bytes());
    [words, bytes("body", &body), check, bytes("frame", &frame)].concat()
}

/// What follows a heading of a block.
fn part(block: &str, heading: &str) -> String {
    let mut within = false;
    let parts = block.lines().filter_map(|line| {
        let (head, rest) = line.split_at(9);
        within = if head.trim().is_empty() { within } else { head.trim() == heading };
        within.then_some(rest)
    });
    parts.collect::<Vec<_>>().join(" ")
}

/// The tables of the page: what its types are made of.
#[derive(Default)]
struct Tables {
    /// Fields of a table with fields, and their types.
    fields: BTreeMap<String, Vec<(String, String)>>,
    /// Rows of a table with numbers: name, and what it holds.
    variants: BTreeMap<String, Vec<(String, String)>>,
}

impl Tables {
    fn read(page: &mut Page) -> Self {
        let mut tables = Self::default();
        let (mut name, mut kind, mut at) = (String::new(), "", 0);
        let mut checked = Vec::new();
        for line in page.text.split_inclusive('\n') {
            let begin = at;
            at += line.len();
            if let Some(heading) = line.strip_prefix("### ") {
                name = heading.trim().to_owned();
            } else if line.starts_with("| field | type | unit |") {
                kind = "fields";
            } else if line.starts_with("| number | name | holds |") {
                kind = "variants";
            } else if !line.starts_with('|') {
                kind = "";
            } else if !kind.is_empty() && !line.starts_with("|---") {
                let cells = cells(line);
                // Up to the third bar: name and type, or number and name; and what it holds.
                let bars = if kind == "fields" { 3 } else { 4 };
                let end = line.match_indices('|').nth(bars - 1).unwrap().0;
                checked.push(begin..begin + end);
                if kind == "fields" {
                    let row = (cells[0].clone(), cells[1].clone());
                    tables.fields.entry(name.clone()).or_default().push(row);
                } else {
                    let rows = tables.variants.entry(name.clone()).or_default();
                    assert_eq!(
                        cells[0],
                        rows.len().to_string(),
                        "number of {} in {name}",
                        cells[1]
                    );
                    rows.push((cells[1].clone(), cells[2].clone()));
                }
            }
        }
        page.checked.extend(checked);
        tables
    }

    /// What a row of a table with numbers holds: nothing, fields in the row itself, or another type.
    fn held(holds: &str) -> Option<Vec<(String, String)>> {
        let field = |field: &str| {
            let (name, kind) = field.split_once(": ").unwrap();
            (name.to_owned(), kind.to_owned())
        };
        match holds {
            "–" => Some(Vec::new()),
            fields if fields.contains(": ") => Some(fields.split(", ").map(field).collect()),
            _ => None,
        }
    }

    /// The value of a type at the beginning of the bytes, as JSON; `seen` are the rows that were needed.
    fn decode(
        &self,
        kind: &str,
        bytes: &mut &[u8],
        seen: &mut BTreeSet<(String, String)>,
    ) -> Value {
        fn varint(bytes: &mut &[u8], bits: u32) -> u64 {
            let mut number = 0_u64;
            for shift in (0..).step_by(7) {
                let [byte] = *take(bytes, 1) else { unreachable!() };
                number |= u64::from(byte & 0x7F) << shift;
                if byte < 0x80 {
                    break;
                }
            }
            assert!(bits == 64 || number < 1 << bits);
            number
        }
        fn take<'b>(bytes: &mut &'b [u8], count: usize) -> &'b [u8] {
            let (taken, rest) = bytes.split_at(count);
            *bytes = rest;
            taken
        }
        let length = |bytes: &mut &[u8], most: &str| {
            let length = varint(bytes, 32) as usize;
            assert!(length <= most.parse().unwrap());
            length
        };
        if let Some(inner) = kind.strip_prefix("option of ") {
            return match take(bytes, 1) {
                [0] => Value::Null,
                [1] => self.decode(inner, bytes, seen),
                other => panic!("an option begins with {other:?}"),
            };
        }
        if let Some((kind, most)) = kind.split_once(" ≤ ") {
            let length = length(bytes, most);
            return match kind {
                "bytes" => hex(take(bytes, length)).into(),
                "text" => std::str::from_utf8(take(bytes, length)).unwrap().into(),
                "list of f32" => (0..length).map(|_| self.decode("f32", bytes, seen)).collect(),
                _ => panic!("a list of what? {kind}"),
            };
        }
        match kind {
            "byte" => take(bytes, 1)[0].into(),
            "u16" => varint(bytes, 16).into(),
            "u32" => varint(bytes, 32).into(),
            "u64" => varint(bytes, 64).into(),
            "f32" => {
                let number = f32::from_le_bytes(take(bytes, 4).try_into().unwrap());
                serde_json::from_str(&serde_json::to_string(&number).unwrap()).unwrap()
            }
            _ if kind.ends_with(" bytes") => {
                let (count, _) = kind.split_once(' ').unwrap();
                hex(take(bytes, count.parse().unwrap())).into()
            }
            _ => {
                if let Some(fields) = self.fields.get(kind) {
                    return self.fields(fields, bytes, seen);
                }
                let rows = self.variants.get(kind).unwrap_or_else(|| panic!("no type {kind}"));
                let (name, holds) = &rows[varint(bytes, 32) as usize];
                seen.insert((kind.to_owned(), name.clone()));
                let held = match Self::held(holds) {
                    Some(fields) if fields.is_empty() => return name.clone().into(),
                    Some(fields) => self.fields(&fields, bytes, seen),
                    None => self.decode(holds, bytes, seen),
                };
                Map::from_iter([(name.clone(), held)]).into()
            }
        }
    }

    fn fields(
        &self,
        fields: &[(String, String)],
        bytes: &mut &[u8],
        seen: &mut BTreeSet<(String, String)>,
    ) -> Value {
        let values =
            fields.iter().map(|(name, kind)| (name.clone(), self.decode(kind, bytes, seen)));
        values.collect::<Map<_, _>>().into()
    }

    /// The longest value of a type, with these rows of tables with numbers; the list or varint with the
    /// number `beyond` is one more than it may be.
    fn longest(
        &self,
        kind: &str,
        rows: &BTreeMap<&str, usize>,
        beyond: Option<usize>,
        limits: &mut usize,
        out: &mut Vec<u8>,
    ) {
        if let Some(inner) = kind.strip_prefix("option of ") {
            out.push(1);
            return self.longest(inner, rows, beyond, limits, out);
        }
        if let Some((kind, most)) = kind.split_once(" ≤ ") {
            let count = most.parse::<usize>().unwrap() + usize::from(beyond == Some(*limits));
            *limits += 1;
            match count {
                0..0x80 => out.push(count as u8),
                _ => out.extend([count as u8 | 0x80, (count >> 7) as u8]),
            }
            let size = if kind == "list of f32" { 4 } else { 1 };
            return out.extend(vec![b'x'; count * size]);
        }
        let mut varint = |bits: usize| {
            let is_beyond = beyond == Some(*limits);
            *limits += 1;
            let (others, last) = (bits / 7, (1 << (bits % 7)) - 1);
            let [others, last] = if is_beyond {
                [vec![0x80; others], vec![last + 1]]
            } else {
                [vec![0xFF; others], vec![last]]
            };
            out.extend([others, last].concat());
        };
        match kind {
            "u16" => varint(16),
            "u32" => varint(32),
            "u64" => varint(64),
            "byte" => out.push(0xFF),
            _ if kind.ends_with(" bytes") => {
                let (count, _) = kind.split_once(' ').unwrap();
                out.extend(vec![0xFF; count.parse().unwrap()]);
            }
            _ => {
                let inline;
                let fields = match self.fields.get(kind) {
                    Some(fields) => fields,
                    None => {
                        let row = rows.get(kind).copied().unwrap_or(0);
                        out.push(row as u8);
                        let holds = &self.variants[kind][row].1;
                        let Some(fields) = Self::held(holds) else {
                            return self.longest(holds, rows, beyond, limits, out);
                        };
                        inline = fields;
                        &inline
                    }
                };
                for (_, kind) in fields {
                    self.longest(kind, rows, beyond, limits, out);
                }
            }
        }
    }
}

#[test]
fn the_golden_messages_are_what_the_code_makes_and_takes() {
    let mut page = Page::read("protocol.md");
    let tables = Tables::read(&mut page);
    let mut names: BTreeSet<String> = page.blocks().into_iter().collect();
    let mut seen = BTreeSet::new();
    for (name, message) in golden() {
        page.golden(name, &block(&message));
        names.remove(name);
        // The page's, not ours.
        let Some(block) = page.block(name) else { continue };
        let frame = unhex(&part(&block, "frame"));
        assert_eq!(received(&frame), [Received::Message(message)], "{name}");
        let body = unhex(&part(&block, "body"));
        assert_eq!(framed(&body), frame, "{name}");
        let check = unhex(&part(&block, "check"));
        assert_eq!(check, crc32(&body).to_le_bytes(), "{name}");
        let mut rest = &body[..];
        let decoded = tables.decode("Message", &mut rest, &mut seen);
        let said: Value = serde_json::from_str(&part(&block, "message")).unwrap();
        assert_eq!((decoded, rest), (said, &[][..]), "{name}");
    }
    names.remove("signatures");
    assert!(names.is_empty(), "there are no such messages: {names:?}");
    assert!(page.wrong.is_empty(), "\n{}", page.wrong.join("\n"));
}

#[test]
fn the_tables_are_those_of_the_code() {
    let mut page = Page::read("protocol.md");
    let tables = Tables::read(&mut page);
    let mut seen = BTreeSet::new();
    let golden = golden().into_iter().map(|(_, message)| message);
    for message in golden.chain(others()) {
        let body = body(&encoded(&message));
        let mut rest = &body[..];
        let decoded = tables.decode("Message", &mut rest, &mut seen);
        let said: Value = serde_json::from_str(&json(&message)).unwrap();
        assert_eq!((decoded, rest), (said, &[][..]));
    }
    for (table, rows) in &tables.variants {
        for (row, _) in rows {
            assert!(seen.contains(&(table.clone(), row.clone())), "{table}::{row} is not compared");
        }
    }

    // Each row with everything as large as it may be is a message, with one list or number beyond that it is none.
    let count = |table: &str| tables.variants[table].len();
    let mut longest = 0;
    let rows = |message, of: &'static str, row| BTreeMap::from([("Message", message), (of, row)]);
    let all = (0..count("Message"))
        .map(|row| rows(row, "Message", row))
        .chain((0..count("Ask")).map(|row| rows(5, "Ask", row)))
        .chain((0..count("Say")).map(|row| rows(6, "Say", row)))
        .chain(
            (0..count("Refused"))
                .map(|row| BTreeMap::from([("Message", 6), ("Say", 8), ("Refused", row)])),
        )
        .chain((0..count("Mode")).map(|row| rows(4, "Mode", row)))
        .chain((0..count("Which")).map(|row| rows(6, "Which", row)));
    for rows in all {
        let (mut limits, mut body) = (0, Vec::new());
        tables.longest("Message", &rows, None, &mut limits, &mut body);
        let frame = framed(&body);
        longest = longest.max(frame.len());
        assert!(matches!(received(&frame)[..], [Received::Message(_)]), "{rows:?}");
        for beyond in 0..limits {
            let mut body = Vec::new();
            tables.longest("Message", &rows, Some(beyond), &mut 0, &mut body);
            let found = received(&framed(&body));
            assert!(matches!(found[..], [Received::Unknown { .. }]), "{rows:?}, limit {beyond}");
        }
        let [first, number, ..] = body[..] else { continue };
        let found = received(&framed(&[&body[..], &[0]].concat()));
        let number = if first == 5 { number } else { 0 };
        assert_eq!(found, [Received::Unknown { variant: first, number }], "a byte too many");
    }
    // There are no further rows, whatever they may hold.
    let (ask, say) = (count("Ask") as u8, count("Say") as u8);
    let (refused, message) = (count("Refused") as u8, count("Message") as u8);
    let prefixes = [vec![message], vec![5, 1, ask], vec![6, 1, say], vec![6, 1, 8, refused]];
    for prefix in prefixes {
        for more in 0..(MAX_FRAME - 8).saturating_sub(prefix.len()) {
            // Lists of one byte, zeros, and options that are none all are read from zeros.
            let found = received(&framed(&[&prefix[..], &vec![0; more]].concat()));
            assert!(matches!(found[..], [Received::Unknown { .. }]), "{prefix:?} and {more} zeros");
        }
    }
    let beyond = |[a, b]: [Message; 2], table: &str| {
        let [mut a, b] = [a, b].map(|message| body(&encoded(&message)));
        let at = (0..a.len()).find(|at| a[*at] != b[*at]).unwrap();
        a[at] = count(table) as u8;
        assert!(matches!(received(&framed(&a))[..], [Received::Unknown { .. }]), "{table}");
    };
    let modes = [Mode::Idle, Mode::Safe];
    beyond(modes.map(|mode| Message::Frame(Frame { mode, ..frame() })), "Mode");
    beyond(modes.map(|mode| answer(1, Say::Hello(Hello { mode, ..hello() }))), "Mode");
    let which = [Which::A, Which::B].map(|which| answer(1, Say::Hello(Hello { which, ..hello() })));
    beyond(which, "Which");

    page.holds(&format!("makes one of {longest} bytes"));
    assert!(page.wrong.is_empty(), "\n{}", page.wrong.join("\n"));
}

#[test]
fn the_signatures_are_right() {
    let mut page = Page::read("protocol.md");
    let hex_lines =
        |heading, bytes: &[u8]| lines(heading, bytes.iter().map(|b| format!("{b:02x}")), 105);
    let mut text = hex_lines("secret", &unhex(SECRET)) + &hex_lines("public", &unhex(PUBLIC));
    for (purpose, name) in Purpose::ALL.into_iter().zip(["install", "activate", "confirm", "abort"])
    {
        if purpose == Purpose::Install {
            text += &hex_lines("signed", &statement(purpose, &release()));
        }
        text += &hex_lines(name, &signed(purpose));
    }
    page.golden("signatures", &text);
    assert!(page.wrong.is_empty(), "\n{}", page.wrong.join("\n"));

    let block = page.block("signatures").unwrap();
    let key = PublicKey(unhex(&part(&block, "public")).try_into().unwrap());
    let signature = unhex(&part(&block, "install"));
    let said: [u8; 64] = unhex(&part(&block, "signed")).try_into().unwrap();
    assert!(key.accepts(&said, &signature));
    for bit in 0..64 * 8 {
        let altered = |bytes: &[u8]| {
            let mut bytes = bytes.to_vec();
            bytes[bit / 8] ^= 1 << (bit % 8);
            bytes
        };
        assert!(!key.accepts(&said, &altered(&signature)), "bit {bit} of the signature");
        assert!(!key.accepts(&altered(&said).try_into().unwrap(), &signature), "bit {bit}");
    }
    for purpose in ["activate", "confirm", "abort"] {
        assert!(!key.accepts(&said, &unhex(&part(&block, purpose))), "{purpose} does not install");
    }
    assert!(!key.accepts(&said, &signature[1..]) && !key.accepts(&said, &[]));
    // S and the order of the group is the same number, but not below the order.
    let order = unhex("edd3f55c1a631258d69cf7a2def9de1400000000000000000000000000000010");
    let mut carry = 0;
    let mut larger = signature.clone();
    for (byte, add) in larger[32..].iter_mut().zip(order) {
        let sum = u16::from(*byte) + u16::from(add) + carry;
        (*byte, carry) = (sum as u8, sum >> 8);
    }
    assert!(carry == 0 && !key.accepts(&said, &larger));
    // The neutral element as key and R, and S = 0: what anybody could sign.
    let mut neutral = [0; 32];
    neutral[0] = 1;
    let anybody = [neutral, [0; 32]].concat();
    assert!(!PublicKey(neutral).accepts(&said, &anybody) && !key.accepts(&said, &anybody));
}

#[test]
fn the_numbers_of_the_protocol_are_those_of_the_code() {
    let mut page = Page::read("protocol.md");
    let tables = Tables::read(&mut page);
    for name in page.blocks() {
        page.block(&name);
    }

    // Line and frames.
    let baud = UartSettings::default().baud.to_string();
    let (high, low) = baud.split_at(baud.len() - 3);
    page.holds(&format!("{high},{low} baud by default"));
    page.holds(&format!("This is version {PROTOCOL} of the protocol"));
    page.holds(&format!("| `protocol` | byte | | version of the protocol: {PROTOCOL} |"));
    page.holds(&format!("A frame has at most {MAX_FRAME} bytes, the final zero included"));
    page.holds(&format!("a frame of {MAX_FRAME} bytes is taken"));
    page.holds("COBS( body ‖ CRC-32 of body ) ‖ 00");
    page.holds("| option of *type* | 00: there is none; 01, then the value |"); // Tables::decode
    // One code byte, four of the CRC-32, one zero.
    let frame = |length: usize| framed(&vec![0; length - 6]);
    assert_eq!(received(&frame(MAX_FRAME)), [Received::Unknown { variant: 0, number: 0 }]);
    assert_eq!(received(&frame(MAX_FRAME + 1)), [Received::TooLong]);
    let check = crc32(b"123456789");
    assert_eq!(robot("123456789"), check);
    page.holds(&format!("| of the nine bytes `123456789` | 0x{check:08X} |"));
    page.holds("makes one of 213 bytes"); // the_tables_are_those_of_the_code
    for (n, code) in [(0, 1), (1, 2), (253, 254)] {
        // n + 1, up to runs of 254.
        assert_eq!(stuff(&vec![7; n])[0], code);
    }
    page.holds("each run of n bytes without its zero becomes the byte n + 1");

    let stop = encoded(&Message::Stop);
    let twice = [&[0, 0], &stop[..], &[0, 0], &stop].concat();
    assert_eq!(received(&twice).len(), 2, "zeros after zeros are skipped");
    for row in page.table("| frame | found |") {
        let frame = row[0].clone();
        let found = match &received(&unhex(&frame))[..] {
            [Received::Unknown { variant, number }] => {
                format!("unknown, first byte {variant}, number {number}")
            }
            [Received::Damaged] => "damaged".to_owned(),
            other => panic!("{frame}: {other:?}"),
        };
        page.holds(&format!("| `{frame}` | {found} |"));
    }
    let of_request = body(&encoded(&request(9, Ask::Hello)));
    let of_answer = body(&encoded(&answer(9, Say::Hello(hello()))));
    let of_refusal = body(&encoded(&refused(9, Refused::Unknown { variant: 77 })));
    let ([ask, 9, 0], [say, 9, 0, PROTOCOL, ..]) = (&of_request[..], &of_answer[..]) else {
        panic!("what never changes has changed: {of_request:?} {of_answer:?}")
    };
    let [_, 9, no, 0, 77] = of_refusal[..] else { panic!("{of_refusal:?}") };
    page.holds(&format!(
        "unknown, first byte {ask} | answers `Refused(Unknown)` with the second byte"
    ));
    page.holds("another first byte | answers `Refused(Unknown)` with number 0");
    page.holds("answers `Refused(TooLong)` with number 0");
    page.holds("`Inputs` of another robot | answers `Refused(Unknown)` with number 0");
    page.holds("that of the request; 0 when it could not be read");
    page.holds(&format!("`Request` is number {ask} and `Answer` number {say} of `Message`"));
    page.holds("`Ask::Hello` is number 0");
    page.holds("`Say::Hello` is number 0");
    page.holds(&format!("`Refused` is number {no} of `Say`; in it `Unknown` is number 0"));
    page.holds(&format!("So `{ask:02x} n 00` is understood"));
    page.holds(&format!("`{say:02x} n 00 p`: version p, and `{say:02x} n {no:02x}`: no"));

    // Alarms.
    page.holds("bit 0 is the lowest");
    let mut bits = 0;
    for (alarm, name) in Alarms::all() {
        assert_eq!(alarm.bits(), 1 << bits);
        let stops = if alarm.intersects(Alarms::SAFE) { "yes" } else { "no" };
        page.holds(&format!("| {bits} | {name} | {stops} |"));
        bits += 1;
    }
    assert_eq!(page.table("| bit | name | stops |").len(), bits);

    // Lists have the lengths of the code: also that of the tables, which are compared byte by byte.
    let kind = |table: &str, field: &str| {
        let (_, kind) = tables.fields[table].iter().find(|(name, _)| name == field).unwrap();
        kind.clone()
    };
    assert_eq!(kind("Frame", "applied"), format!("list of f32 ≤ {MAX_INPUTS}"));
    assert_eq!(kind("Frame", "measured"), format!("list of f32 ≤ {MAX_STATES}"));
    assert_eq!(kind("Chunk", "bytes"), format!("bytes ≤ {MAX_CHUNK}"));
    assert_eq!(kind("Begin", "signature"), format!("bytes ≤ {SIGNATURE}"));
    page.holds("from 1 on, another one for each new request");
    let mut memory = Memory::new(4096);
    let mut controller = Controller::boot(&mut memory, None);
    let Some(Say::Hello(of_factory)) = controller.receive(1, &Ask::Hello) else { panic!() };
    assert_eq!(of_factory.release, Release { sequence: 0, ..release() });
    assert_eq!((of_factory.which, of_factory.trial, of_factory.key), (Which::Factory, None, None));
    page.holds("of the factory model its length and hash, and sequence number 0");
    assert_eq!(Capacities::new::<3, 2>(1, 0).instructions, 0);
    page.holds("of one step, at most; 0 where that is not known");

    // Signatures and sessions.
    page.holds("With the secret key of RFC 8032, section 7.1, test 1,");
    page.holds(&format!(
        "Signed are these {} bytes",
        statement(Purpose::Install, &release()).len()
    ));
    page.holds(&format!("The signature is Ed25519 (RFC 8032), {SIGNATURE} bytes"));
    let (said, release) = (statement(Purpose::Abort, &release()), release());
    let mut at = 0;
    for (name, field) in [
        ("the bytes `koopman-release` and a zero", &b"koopman-release\0"[..]),
        ("purpose", &[Purpose::Abort as u8]),
        ("zeros", &[0; 3]),
        ("robot: CRC-32 of its name", &crc32(ROBOT.as_bytes()).to_le_bytes()),
        ("sequence number", &SEQUENCE.to_le_bytes()),
        ("length of the blob", &release.length.to_le_bytes()),
        ("SHA-256 of the blob", &release.sha256),
    ] {
        page.holds(&format!("| {at} | {} | {name} |", field.len()));
        assert_eq!(said[at..at + field.len()], *field);
        at += field.len();
    }
    assert_eq!(at, said.len());
    for (purpose, name) in Purpose::ALL.into_iter().zip(["install", "activate", "confirm", "abort"])
    {
        page.holds(&format!("| {} | {name} |", purpose as u8));
    }
    assert_eq!(page.table("| purpose | | allows |").len(), Purpose::ALL.len());
    page.holds(&format!("no signature is looked at for {} s:", SIGNATURE_PAUSE_US as f64 / 1e6));
    page.holds(&format!("heard for more than {} s.", SILENCE_US as f64 / 1e6));
    page.finish();
}

/// A controller's end of an update, at a time and in a mode.
struct Controller<'m> {
    updater: Updater<'static, &'m mut Memory<4, 1024>, Option<PublicKey>, fn(Payload) -> bool>,
    now_us: u64,
    mode: Mode,
}

impl<'m> Controller<'m> {
    fn boot(memory: &'m mut Memory<4, 1024>, key: Option<PublicKey>) -> Self {
        let capacities = Capacities::new::<3, 2>(100_000, 0);
        let (erase_ms, good_ticks) = (2000, 3);
        let (firmware, robot, factory) = ("test", ROBOT, BLOB);
        let identity = Identity { firmware, robot, factory, capacities, erase_ms, good_ticks };
        let geometry = Geometry { offset: 0, slot_bytes: 2048 };
        let accept: fn(Payload) -> bool = |_| true;
        let (updater, _) = Updater::boot(memory, geometry, identity, 0, key, accept).unwrap();
        Self { updater, now_us: 0, mode: Mode::Safe }
    }

    fn receive(&mut self, number: u8, ask: &Ask) -> Option<Say> {
        let request = Request { number, ask: ask.clone() };
        let mut answers = Answers::new();
        self.updater.receive(request, self.mode, self.now_us, &mut answers);
        let answer = answers.take()?;
        assert_eq!(answer.number, number);
        Some(answer.say)
    }

    /// Until there is an answer.
    fn work(&mut self) -> Say {
        let mut answers = Answers::new();
        for _ in 0..100 {
            assert!(self.updater.is_working());
            self.updater.work(self.mode, self.now_us, &mut answers);
            if let Some(answer) = answers.take() {
                return answer.say;
            }
        }
        panic!("no answer")
    }

    fn ask(&mut self, number: u8, ask: &Ask) -> Say {
        self.receive(number, ask).unwrap_or_else(|| self.work())
    }

    /// A request, the same again while it is worked on, which says nothing, and what it says.
    fn twice(&mut self, number: u8, ask: &Ask) -> Say {
        assert_eq!(self.receive(number, ask), None);
        assert_eq!(self.receive(number, ask), None, "nothing");
        assert_eq!(self.receive(number + 100, &verify()), Some(Say::Refused(Refused::Working)));
        self.work()
    }
}

#[test]
fn requests_may_be_repeated_as_specified() {
    let mut page = Page::read("protocol.md");
    let mut row = |ask: &Ask, again: &str, after: &Say| {
        let name = |debug: String| {
            let words = debug.trim_start_matches("Refused(");
            words.split(|c: char| !c.is_alphanumeric()).next().unwrap().to_owned()
        };
        let (ask, after) = (name(format!("{ask:?}")), name(format!("{after:?}")));
        page.holds(&format!("| `{ask}` | {again} | `{after}`"));
    };
    let mut memory = Memory::new(4096);
    let mut controller = Controller::boot(&mut memory, Some(public()));
    let hello = controller.receive(1, &Ask::Hello).unwrap();
    row(&Ask::Hello, "", &hello);

    assert_eq!(controller.twice(2, &begin()), Say::Working { most_ms: 6000 });
    assert_eq!(controller.receive(2, &begin()), Some(Say::Working { most_ms: 6000 }));
    assert_eq!(controller.receive(3, &begin()), Some(Say::Refused(Refused::Working)));
    assert_eq!(controller.work(), Say::Begun { written: 0 });
    let unsigned = Ask::Begin { session: SESSION, release: release(), signature: Signature::new() };
    let after = controller.receive(3, &unsigned).unwrap();
    assert_eq!(after, Say::Begun { written: 0 });
    row(&begin(), "`Working` while the slot is erased, else nothing", &after);

    assert_eq!(controller.twice(4, &chunk()), Say::Written { written: 7 });
    let after = controller.receive(4, &chunk()).unwrap();
    assert_eq!(after, Say::Refused(Refused::OutOfOrder { written: 7 }));
    row(&chunk(), "nothing", &after);

    assert_eq!(controller.twice(5, &verify()), Say::Verified);
    row(&verify(), "nothing", &controller.ask(5, &verify()));

    assert_eq!(controller.twice(6, &activate()), Say::Activated);
    row(&activate(), "nothing", &controller.receive(6, &activate()).unwrap());
    assert_eq!(controller.receive(7, &verify()), Some(Say::Refused(Refused::Working)));
    // However long the reset takes, nobody starts the robot before it.
    assert!(controller.updater.holds(10 * SILENCE_US) && controller.updater.holds(20 * SILENCE_US));
    let mut controller = Controller::boot(&mut memory, Some(public()));
    let no_session = Some(Say::Refused(Refused::NoSession));
    assert_eq!(controller.receive(6, &activate()), no_session);

    let early = Say::Refused(Refused::TooEarly { good: 0, needed: 3 });
    assert_eq!(controller.receive(8, &confirm()), Some(early.clone()));
    assert_eq!(controller.receive(8, &begin()), Some(Say::Refused(Refused::OnTrial)));
    for _ in 0..3 {
        controller.updater.ticked(Alarms::OUTLIER);
    }
    // A bad tick between question and answer.
    for bad in [Alarms::RESIDUAL, Alarms::LATE] {
        assert_eq!(controller.receive(8, &confirm()), None);
        controller.updater.ticked(bad);
        assert_eq!(controller.work(), early);
        for _ in 0..3 {
            controller.updater.ticked(Alarms::OUTLIER);
        }
    }
    assert_eq!(controller.twice(9, &confirm()), Say::Confirmed);
    row(&confirm(), "nothing", &controller.receive(9, &confirm()).unwrap());

    assert_eq!(controller.ask(10, &begin()), Say::Working { most_ms: 6000 });
    assert_eq!(controller.work(), Say::Begun { written: 0 });
    assert_eq!(controller.twice(11, &abort()), Say::Aborted);
    let after = controller.receive(11, &abort()).unwrap();
    row(&abort(), "nothing", &after);
    assert!(page.wrong.is_empty(), "\n{}", page.wrong.join("\n"));
}

#[test]
fn requests_are_answered_in_the_modes_specified() {
    let mut page = Page::read("protocol.md");
    let asks = [Ask::Hello, begin(), chunk(), verify(), activate(), confirm(), abort()];
    let rows = page.table("| request | Idle, Safe | Running |");
    assert_eq!(rows.len(), asks.len());
    for (ask, row) in asks.iter().zip(rows) {
        assert!(format!("{ask:?}").starts_with(&row[0]));
        for mode in [Mode::Idle, Mode::Safe, Mode::Running] {
            let mut memory = Memory::new(4096);
            let mut controller = Controller::boot(&mut memory, Some(public()));
            controller.mode = mode;
            let say = controller.ask(1, ask);
            let busy = say == Say::Refused(Refused::Busy);
            assert_eq!(busy, mode == Mode::Running && row[2] == "Busy", "{ask:?}, {mode:?}");
        }
        let request = Request { number: 7, ask: ask.clone() };
        let mut answers = Answers::new();
        NoUpdates.receive(request, Mode::Idle, 0, &mut answers);
        let say = Say::Refused(Refused::Unknown { variant: 5 });
        assert_eq!(answers.take(), Some(Answer { number: 7, say }));
    }
    page.holds("A controller that takes no updates answers every request, `Hello` too, with `Refused(Unknown)`");
    assert!(page.wrong.is_empty(), "\n{}", page.wrong.join("\n"));
}

#[test]
fn sessions_and_pauses_last_as_specified() {
    let mut memory = Memory::new(4096);
    let mut controller = Controller::boot(&mut memory, Some(public()));
    let wrong = Ask::Begin { session: 1, release: release(), signature: signed(Purpose::Abort) };
    assert_eq!(controller.ask(1, &wrong), Say::Refused(Refused::Signature));
    let pause = Say::Refused(Refused::Pause { ms: 1000 });
    assert_eq!(controller.ask(2, &begin()), pause);
    controller.now_us = SIGNATURE_PAUSE_US;
    assert_eq!(controller.ask(2, &begin()), Say::Working { most_ms: 6000 });
    for _ in 0..3 {
        controller.now_us += 10 * SILENCE_US;
        assert!(controller.updater.holds(controller.now_us), "it is worked on");
    }
    assert_eq!(controller.work(), Say::Begun { written: 0 });
    // The time before the work, that after it, and from there on.
    assert!(controller.updater.holds(controller.now_us));
    controller.now_us += 10 * SILENCE_US;
    assert!(controller.updater.holds(controller.now_us));
    controller.now_us += SILENCE_US;
    assert!(controller.updater.holds(controller.now_us));
    let other = Ask::Begin { session: 2, release: release(), signature: signed(Purpose::Install) };
    assert_eq!(controller.ask(3, &other), Say::Refused(Refused::InUse));
    controller.ask(3, &Ask::Hello);
    controller.now_us += 1;
    assert!(!controller.updater.holds(controller.now_us), "a hello keeps no session");
    assert_eq!(controller.ask(4, &chunk()), Say::Refused(Refused::NoSession));
    assert_eq!(controller.ask(5, &other), Say::Begun { written: 0 }, "what is erased stays so");

    // What was written is not what was signed: the session ends with that.
    let bytes = b"koopmaN".iter().copied().collect();
    let said = controller.ask(6, &Ask::Chunk { session: 2, offset: 0, bytes });
    assert_eq!(said, Say::Written { written: 7 });
    assert_eq!(controller.ask(7, &Ask::Verify { session: 2 }), Say::Refused(Refused::Hash));
    assert!(!controller.updater.holds(controller.now_us));
}

#[test]
fn a_session_goes_on_anew_or_ends_with_what_is_signed_for_that() {
    let mut memory = Memory::new(4096);
    let mut controller = Controller::boot(&mut memory, Some(public()));
    let (working, begun) = (Say::Working { most_ms: 6000 }, Say::Begun { written: 0 });
    let wrong = Say::Refused(Refused::Signature);
    assert_eq!(controller.ask(1, &begin()), working);
    // Whoever has not held the robot yet does not get it erased.
    controller.mode = Mode::Idle;
    for _ in 0..3 {
        let mut answers = Answers::new();
        controller.updater.work(controller.mode, controller.now_us, &mut answers);
        assert_eq!(answers.take(), None);
        assert!(controller.updater.is_working());
    }
    controller.mode = Mode::Safe;
    assert_eq!(controller.work(), begun);
    let chunk = |offset, bytes: &[u8]| Ask::Chunk {
        session: SESSION,
        offset,
        bytes: bytes.iter().copied().collect(),
    };
    // Too much, and then all but one.
    let out_of_order = Say::Refused(Refused::OutOfOrder { written: 0 });
    assert_eq!(controller.ask(2, &chunk(0, b"koopman!")), out_of_order);
    assert_eq!(controller.ask(3, &chunk(0, b"koopma")), Say::Written { written: 6 });
    // What is answered at once is heard, too.
    assert!(controller.updater.holds(controller.now_us) && controller.updater.holds(0));
    for number in 4..8 {
        controller.now_us += SILENCE_US;
        assert_eq!(controller.ask(number, &chunk(6, b"")), Say::Written { written: 6 });
    }

    // Another release, in the same session: signed as the first one was, and on an erased slot.
    let next = Release { sequence: SEQUENCE + 1, ..release() };
    let of_next = |signature| Ask::Begin { session: SESSION, release: next, signature };
    assert_eq!(controller.ask(8, &of_next(signed(Purpose::Install))), wrong);
    assert!(controller.updater.holds(controller.now_us));
    assert!(controller.updater.holds(controller.now_us));
    controller.now_us += SIGNATURE_PAUSE_US;
    let sign = |purpose| {
        keys().sk.sign(statement(purpose, &next), None).iter().copied().collect::<Signature>()
    };
    assert_eq!(controller.ask(9, &of_next(sign(Purpose::Install))), working);
    assert_eq!(controller.work(), begun);

    for purpose in [Purpose::Install, Purpose::Activate, Purpose::Confirm, Purpose::Abort] {
        let signature = sign(purpose);
        let said = controller.ask(10, &Ask::Abort { session: SESSION, signature });
        let over = purpose == Purpose::Abort;
        assert_eq!(said, if over { Say::Aborted } else { wrong.clone() }, "{purpose:?}");
        controller.updater.holds(controller.now_us);
        assert_eq!(controller.updater.holds(controller.now_us), !over);
        controller.now_us += SIGNATURE_PAUSE_US;
    }

    // A flash that fails ends it, too.
    let mut memory = Memory::new(4096);
    memory.broken.insert(320 / 4);
    memory.reports = true;
    let mut controller = Controller::boot(&mut memory, Some(public()));
    controller.ask(1, &begin());
    assert_eq!(controller.work(), begun);
    assert_eq!(controller.ask(2, &self::chunk()), Say::Written { written: 7 });
    assert!(controller.updater.holds(0));
    assert_eq!(controller.ask(3, &verify()), Say::Refused(Refused::Flash));
    assert!(!controller.updater.holds(0));
}

/// A robot that does nothing, and its line.
struct Robot(Supervisor);

impl ControlLoop<2> for Robot {
    fn command(&mut self, _: Command<2>) {}

    fn tick(&mut self, _: u64) -> Mode {
        self.mode()
    }

    fn finish(&mut self, _: u64) -> Mode {
        self.mode()
    }

    fn path(&self) -> &[f32] {
        &[]
    }

    fn supervisor(&self) -> &Supervisor {
        &self.0
    }

    fn supervisor_mut(&mut self) -> &mut Supervisor {
        &mut self.0
    }
}

/// Bytes to be read, and those that were written.
#[derive(Default)]
struct Line(VecDeque<u8>, Vec<u8>);

impl embedded_io::ErrorType for Line {
    type Error = embedded_io::ErrorKind;
}

impl embedded_io::Read for Line {
    fn read(&mut self, bytes: &mut [u8]) -> Result<usize, Self::Error> {
        Ok(bytes
            .iter_mut()
            .zip(from_fn(|| self.0.pop_front()))
            .map(|(to, byte)| *to = byte)
            .count())
    }
}

impl embedded_io::ReadReady for Line {
    fn read_ready(&mut self) -> Result<bool, Self::Error> {
        Ok(!self.0.is_empty())
    }
}

impl embedded_io::Write for Line {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Self::Error> {
        self.1.extend(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> Result<(), Self::Error> {
        Ok(())
    }
}

impl embedded_io::WriteReady for Line {
    fn write_ready(&mut self) -> Result<bool, Self::Error> {
        Ok(true)
    }
}

/// What a controller that takes no updates says to these bytes.
fn said(bytes: &[u8]) -> Vec<Message> {
    let timing = Timing { period_us: 10_000, watchdog_us: 1_000_000 };
    let (mut robot, mut port) = (Robot(Supervisor::new(timing)), Port::new());
    let mut line = Line(bytes.iter().copied().collect(), Vec::new());
    let mut queue = Queue::<2>::new();
    let (_, mut frames) = queue.split();
    while !line.0.is_empty() {
        port.receive(&mut line, &mut robot, &mut NoUpdates, 0);
    }
    while !port.is_sent() {
        port.send(&mut frames, &mut line);
    }
    let messages = received(&line.1).into_iter().map(|received| match received {
        Received::Message(message) => message,
        other => panic!("{other:?}"),
    });
    messages.collect()
}

#[test]
fn what_is_no_request_is_answered_as_specified() {
    let unknown = |number, variant| vec![refused(number, Refused::Unknown { variant })];
    let inputs = |count| Message::Inputs(vec![1.0; count].into_iter().collect());
    let mut damaged = encoded(&Message::Stop);
    damaged[1] ^= 1;
    let most = MAX_FRAME as u32;
    for (what, bytes, answer) in [
        ("a command", encoded(&Message::Stop), vec![]),
        ("inputs", encoded(&inputs(2)), vec![]),
        ("damaged", damaged, vec![]),
        (
            "too long",
            [[1; MAX_FRAME].as_slice(), &[0]].concat(),
            vec![refused(0, Refused::TooLong { most })],
        ),
        ("unknown, first byte 5", framed(&[5, 9, 99]), unknown(9, 5)),
        ("unknown, another first byte", framed(&[77, 9, 99]), unknown(0, 77)),
        ("inputs of another robot", encoded(&inputs(3)), unknown(0, 3)),
        ("a frame", encoded(&Message::Frame(frame())), vec![]),
        ("an answer", encoded(&answer(3, Say::Verified)), vec![]),
        (
            "three at once",
            encoded(&request(1, Ask::Hello)).repeat(3),
            [unknown(1, 5), unknown(1, 5)].concat(),
        ),
    ] {
        assert_eq!(said(&bytes), answer, "{what}");
    }
}

#[test]
fn telemetry_goes_on_however_much_is_asked() {
    let timing = Timing { period_us: 10_000, watchdog_us: 1_000_000 };
    let (mut robot, mut port) = (Robot(Supervisor::new(timing)), Port::new());
    let mut line = Line::default();
    let mut queue = Queue::<4>::new();
    let (producer, mut frames) = queue.split();
    let mut telemetry = Telemetry::new(producer);
    for _ in 0..50 {
        telemetry.send(Frame::default());
        line.0.extend(encoded(&request(1, Ask::Hello)).repeat(10));
        port.receive(&mut line, &mut robot, &mut NoUpdates, 0);
        port.send(&mut frames, &mut line);
    }
    let said = received(&line.1);
    let is_frame = |said: &&Received| matches!(said, Received::Message(Message::Frame(_)));
    assert_eq!((said.len(), said.iter().filter(is_frame).count()), (100, 50));
}

#[test]
fn a_line_that_takes_nothing_holds_nobody_for_ever() {
    let mut memory = Memory::new(4096);
    let mut controller = Controller::boot(&mut memory, Some(public()));
    let timing = Timing { period_us: 10_000, watchdog_us: 1_000_000 };
    let (mut robot, mut port) = (Robot(Supervisor::new(timing)), Port::new());
    let mut line = Line::default();
    // Nothing that is said gets out; what is asked comes in.
    line.0.extend(encoded(&request(1, begin())));
    let mut held = 0;
    for now_us in (0..60_000_000).step_by(10_000) {
        port.receive(&mut line, &mut robot, &mut controller.updater, now_us);
        robot.0.reset();
        held += u32::from(robot.mode() == Mode::Safe);
    }
    assert!(!controller.updater.is_working());
    assert!(held > 500, "{held} ticks: its session is as long as that of another");
    assert!(held < 1500 && robot.mode() == Mode::Idle, "{held} ticks: it can be used again");
}

/// A flash in memory that is programmed in its units only, each of them once after an erase.
#[derive(Clone)]
struct Memory<const WRITE: usize, const ERASE: usize> {
    bytes: Vec<u8>,
    programmed: Vec<bool>,
    /// Units whose error correction fails.
    broken: BTreeSet<usize>,
    /// Whether the driver says so, or hands out zeros.
    reports: bool,
    /// Bytes programmed so far.
    count: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Failed;

impl NorFlashError for Failed {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

impl<const W: usize, const E: usize> Memory<W, E> {
    /// Never erased: all is to be erased first.
    fn new(capacity: usize) -> Self {
        let (bytes, programmed) = (vec![0xA5; capacity], vec![true; capacity / W]);
        Self { bytes, programmed, broken: BTreeSet::new(), reports: false, count: 0 }
    }

    fn of(bytes: Vec<u8>) -> Self {
        let programmed = bytes.chunks(W).map(|unit| unit.iter().any(|b| *b != 0xFF)).collect();
        Self { bytes, programmed, ..Self::new(0) }
    }
}

impl<const W: usize, const E: usize> ErrorType for Memory<W, E> {
    type Error = Failed;
}

impl<const W: usize, const E: usize> ReadNorFlash for Memory<W, E> {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Failed> {
        let at = offset as usize;
        bytes.copy_from_slice(self.bytes.get(at..at + bytes.len()).ok_or(Failed)?);
        for (byte, at) in bytes.iter_mut().zip(at..) {
            if self.broken.contains(&(at / W)) {
                *byte = 0;
                if self.reports {
                    return Err(Failed);
                }
            }
        }
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.bytes.len()
    }
}

impl<const W: usize, const E: usize> NorFlash for Memory<W, E> {
    const WRITE_SIZE: usize = W;
    const ERASE_SIZE: usize = E;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Failed> {
        let (from, to) = (from as usize, to as usize);
        assert!(from.is_multiple_of(E) && to.is_multiple_of(E) && from < to);
        self.bytes[from..to].fill(0xFF);
        self.programmed[from / W..to / W].fill(false);
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Failed> {
        let at = offset as usize;
        assert!(at.is_multiple_of(W) && bytes.len().is_multiple_of(W), "whole units");
        for unit in &mut self.programmed[at / W..(at + bytes.len()) / W] {
            assert!(!*unit, "a unit is programmed once");
            *unit = true;
        }
        self.bytes[at..at + bytes.len()].copy_from_slice(bytes);
        self.count += bytes.len();
        Ok(())
    }
}

const SLOT: usize = 1024;
const SLOTS: Geometry = Geometry { offset: 0, slot_bytes: SLOT as u32 };

fn boot<F: NorFlash>(flash: F) -> (Slots<F>, Boot<F::Error>) {
    Slots::boot(flash, SLOTS, ROBOT, 0, |_| true).unwrap()
}

fn install<F: NorFlash<Error = Failed>>(slots: &mut Slots<F>) {
    slots.begin(&release()).unwrap();
    while slots.erase().unwrap() > 0 {}
    slots.write(0, BLOB).unwrap();
    slots.verify().unwrap();
    slots.commit().unwrap();
}

/// Sixteen bytes a line, without lines that are erased.
fn dump(slot: &[u8], range: Range<usize>) -> String {
    let rows = slot.chunks(16).zip((0..).step_by(16)).filter(|(_, at)| range.contains(at));
    let rows = rows.filter(|(row, _)| row.iter().any(|byte| *byte != 0xFF));
    let row = |(row, at): (&[u8], usize)| {
        let bytes: Vec<String> = row.iter().map(|byte| format!("{byte:02x}")).collect();
        format!("{at:3}  {}\n", bytes.join(" "))
    };
    rows.map(row).collect()
}

/// What dumps make of an erased slot.
fn undump(dumps: &[String]) -> Vec<u8> {
    let mut slot = vec![0xFF; SLOT];
    for line in dumps.iter().flat_map(|dump| dump.lines()) {
        let (at, bytes) = line.trim_start().split_once(' ').unwrap();
        let (at, bytes) = (at.parse::<usize>().unwrap(), unhex(bytes));
        slot[at..at + bytes.len()].copy_from_slice(&bytes);
    }
    slot
}

#[test]
fn the_golden_slot_is_what_the_code_writes_and_boots() {
    let mut page = Page::read("flash-layout.md");
    let marks = 64..PAYLOAD_OFFSET as usize;
    let mut memory = Memory::<4, SLOT>::new(2 * SLOT);
    install(&mut boot(&mut memory).0);
    let committed = memory.clone();
    let header = [0..64, 320..SLOT].map(|part| dump(&memory.bytes[..SLOT], part)).concat();
    page.golden("slot-header", &header);
    page.golden("slot-committed", &dump(&memory.bytes[..SLOT], marks.clone()));

    let (mut slots, found) = boot(memory);
    assert_eq!((found.running, found.trial, found.floor), (Which::A, true, 0));
    memory = slots.into_flash();
    page.golden("slot-on-trial", &dump(&memory.bytes[..SLOT], marks.clone()));
    let mut memory = committed.clone();
    slots = boot(memory).0;
    slots.confirm().unwrap();
    memory = slots.into_flash();
    page.golden("slot-confirmed", &dump(&memory.bytes[..SLOT], marks.clone()));

    memory = committed.clone();
    boot(&mut memory);
    let (_, found) = boot(&mut memory);
    assert_eq!(found.refused[0], Some(Refusal::Rejected));
    page.golden("slot-rejected", &dump(&memory.bytes[..SLOT], marks.clone()));

    let mut memory = Memory::<4, SLOT>::new(2 * SLOT);
    let (mut slots, _) = boot(&mut memory);
    install(&mut slots);
    slots.abort().unwrap();
    page.golden("slot-aborted", &dump(&memory.bytes[..SLOT], marks));
    assert!(page.wrong.is_empty(), "\n{}", page.wrong.join("\n"));

    // The page's bytes boot as it says.
    let header = page.block("slot-header").unwrap();
    for (stage, running, floor) in [
        ("slot-committed", Which::A, 0),
        ("slot-on-trial", Which::Factory, 0),
        ("slot-confirmed", Which::A, SEQUENCE),
        ("slot-rejected", Which::Factory, 0),
        ("slot-aborted", Which::Factory, 0),
    ] {
        let slot = undump(&[header.clone(), page.block(stage).unwrap()]);
        let mut memory = Memory::<4, SLOT>::of([slot, vec![0xFF; SLOT]].concat());
        let (_, found) = boot(&mut memory);
        assert_eq!((found.running, found.floor), (running, floor), "{stage}");
        assert_eq!(found.trial, stage == "slot-committed");
    }
}

/// Names of the marks, and where the first of their two cells lies.
const MARKS: [(&str, usize); 4] = [("CMIT", 64), ("TRIL", 128), ("CNFM", 192), ("RJCT", 256)];
const CELL: usize = 32;

/// A slot as the page specifies it: what it is, and sequence number and generation.
fn slot(text: &str) -> Vec<u8> {
    let mut slot = vec![0xFF; SLOT];
    let Some((state, numbers)) = text.rsplit_once(' ') else {
        assert_eq!(text, "empty");
        return slot;
    };
    let (sequence, generation) = numbers.split_once('/').unwrap();
    let number = |text: &str| text.parse::<u32>().unwrap().to_le_bytes();
    let mut header = [
        &b"SLOT\x01\0\x40\x01"[..],
        &(BLOB.len() as u32).to_le_bytes(),
        &number(sequence),
        &number(generation),
        &crc32(ROBOT.as_bytes()).to_le_bytes(),
        &sha256(BLOB),
        &[0; 4],
    ]
    .concat();
    let check = crc32(&header).to_le_bytes();
    header.extend(check);
    slot[..64].copy_from_slice(&header);
    slot[320..][..BLOB.len()].copy_from_slice(BLOB);
    let (set, cut): (&[&str], _) = match state {
        "not committed" => (&[], None),
        "fresh" => (&["CMIT"], None),
        "on trial" => (&["CMIT", "TRIL"], None),
        "confirmed" => (&["CMIT", "TRIL", "CNFM"], None),
        "rejected" => (&["CMIT", "TRIL", "RJCT"], None),
        "cut CMIT" => (&[], Some("CMIT")),
        "cut TRIL" => (&["CMIT"], Some("TRIL")),
        "cut CNFM" => (&["CMIT", "TRIL"], Some("CNFM")),
        "cut RJCT" => (&["CMIT", "TRIL"], Some("RJCT")),
        other => panic!("what is {other}?"),
    };
    for (name, at) in MARKS {
        let word = [name.as_bytes(), &check].concat();
        if set.contains(&name) {
            slot[at..][..8].copy_from_slice(&word);
            slot[at + CELL..][..8].copy_from_slice(&word);
        } else if cut == Some(name) {
            slot[at..][..3].copy_from_slice(&word[..3]);
        }
    }
    slot
}

/// The page's table of states.
fn state(slot: &[u8]) -> &'static str {
    let (header, check) = (&slot[..60], &slot[60..64]);
    if header[..4] != *b"SLOT" || crc32(header).to_le_bytes() != *check {
        return "empty";
    }
    let cells = |mark: &str| {
        let (name, at) = MARKS.into_iter().find(|(name, _)| *name == mark).unwrap();
        let set = [name.as_bytes(), check, &[0xFF; 24]].concat();
        [at, at + CELL].map(|at| match &slot[at..][..CELL] {
            cell if *cell == set => "set",
            cell if cell.iter().all(|byte| *byte == 0xFF) => "erased",
            _ => "torn",
        })
    };
    if cells("RJCT") != ["erased"; 2] {
        "rejected"
    } else if !cells("CMIT").contains(&"set") {
        "not committed"
    } else if cells("CNFM").contains(&"set") {
        "confirmed"
    } else if cells("TRIL").contains(&"set") || cells("TRIL") == ["torn"; 2] {
        "rejected"
    } else {
        "fresh"
    }
}

const DECISIONS: &str =
    "| slot A | slot B | runs | floor | slot A afterwards | slot B afterwards |";

#[test]
fn slots_boot_as_specified() {
    let mut page = Page::read("flash-layout.md");
    let rows = page.table(DECISIONS);
    assert!(rows.len() > 10);
    for row in rows {
        let slots = [slot(&row[0]), slot(&row[1])].concat();
        let mut memory = Memory::<4, SLOT>::of(slots);
        let (_, found) = boot(&mut memory);
        let running = match found.running {
            Which::A => "A",
            Which::B => "B",
            Which::Factory => "factory",
        };
        let trial = if found.trial { " on trial" } else { "" };
        let [a, b] = [0, SLOT].map(|at| state(&memory.bytes[at..][..SLOT]));
        let found = [format!("{running}{trial}"), found.floor.to_string(), a.into(), b.into()];
        assert_eq!(row[2..], found, "{row:?}");
    }
}

#[test]
fn the_floor_is_that_of_the_robot() {
    let slots = [slot("confirmed 9/1"), slot("fresh 4/2")].concat();
    let of = |robot| {
        let memory = Memory::<4, SLOT>::of(slots.clone());
        Slots::boot(memory, SLOTS, robot, 0, |_| true).unwrap().1
    };
    assert_eq!((of(ROBOT).floor, of("another").floor), (9, 0));
}

/// What a row of the page says of a flash with such units and sectors.
fn row<const W: usize, const E: usize>(sectors: &str, units: &str) -> String {
    assert!(
        Slots::boot(
            Memory::<W, E>::new(2 * E),
            Geometry { offset: 0, slot_bytes: 320 },
            "",
            0,
            |_| true
        )
        .is_err()
    );
    let geometry = Geometry { offset: 0, slot_bytes: E as u32 };
    let (mut slots, _) =
        Slots::boot(Memory::<W, E>::new(2 * E), geometry, ROBOT, 0, |_| true).unwrap();
    let (room, sectors_of_slot) = (slots.room(), slots.sectors());
    install(&mut slots);
    let memory = slots.into_flash();
    let blob = memory.programmed[320 / W..].iter().take_while(|unit| **unit).count() * W;
    let padded = BLOB.len().next_multiple_of(W);
    assert_eq!(blob, padded);
    let cell = (memory.count - 64 - blob) / 2;
    let bytes = if W == 1 { "byte" } else { "bytes" };
    format!("| {sectors}, {units} | {E} | {room} | {sectors_of_slot} | {cell} | {W} {bytes} |")
}

#[test]
fn the_numbers_of_the_layout_are_those_of_the_code() {
    let mut page = Page::read("flash-layout.md");
    for name in page.blocks() {
        page.block(&name);
    }
    page.holds(&format!("This is version {VERSION} of the layout"));
    page.holds(&format!("| 4 | 2 | version of the layout, {VERSION} |"));
    page.holds(&format!("A slot is larger than {PAYLOAD_OFFSET} bytes. Its room for a blob is its size less {PAYLOAD_OFFSET}."));
    page.holds(&format!(
        "divide {MAX_WRITE_SIZE} bytes; a sector is a multiple of {MAX_WRITE_SIZE} bytes"
    ));
    assert_eq!(MAX_WRITE_SIZE, CELL);
    const KB: usize = 1024;
    page.holds(&row::<4, { 16 * KB }>("sectors of 16 KB", "words of 4 bytes"));
    page.holds(&row::<32, { 16 * KB }>("sectors of 16 KB", "words of 32 bytes"));
    page.holds(&row::<1, { 128 * KB }>("sectors of 128 KB", "single bytes"));

    // Header and marks, in the slot that the code writes.
    let mut memory = Memory::<4, SLOT>::new(2 * SLOT);
    install(&mut boot(&mut memory).0);
    let (slot, release) = (memory.bytes.clone(), release());
    let check = crc32(&slot[..60]).to_le_bytes();
    let mut at = 0;
    for (name, field) in [
        ("magic, the bytes `SLOT`", &b"SLOT"[..]),
        (&format!("version of the layout, {VERSION}"), &VERSION.to_le_bytes()),
        ("offset of the payload, 320", &(PAYLOAD_OFFSET as u16).to_le_bytes()),
        ("length of the payload n, at least 1", &release.length.to_le_bytes()),
        ("sequence number of the update", &SEQUENCE.to_le_bytes()),
        (
            "generation: 1 more than the larger one in either slot when the update began",
            &[1, 0, 0, 0],
        ),
        ("robot: CRC-32 of its name in UTF-8", &crc32(ROBOT.as_bytes()).to_le_bytes()),
        ("SHA-256 of the payload", &release.sha256),
        ("reserved, 0", &[0; 4]),
        ("CRC-32 of bytes 0 to 59", &check),
    ] {
        page.holds(&format!("| {at} | {} | {name} |", field.len()));
        assert_eq!(slot[at..at + field.len()], *field, "{name}");
        at += field.len();
    }
    let mut empty = release;
    empty.length = 0;
    let mut slots = boot(memory).0;
    slots.confirm().unwrap();
    assert!(slots.check(&empty).is_err());
    slots.begin(&Release { sequence: 8, ..release }).unwrap();
    while slots.erase().unwrap() > 0 {}
    slots.write(0, BLOB).unwrap();
    slots.verify().unwrap();
    slots.commit().unwrap();
    assert_eq!(slots.into_flash().bytes[SLOT..][16..20], [2, 0, 0, 0], "the generation");
    for (name, [first, second]) in MARKS.map(|(name, at)| (name, [at, at + CELL])) {
        let what = match name {
            "CMIT" => "committed",
            "TRIL" => "trial begun",
            "CNFM" => "confirmed",
            _ => "rejected",
        };
        page.holds(&format!("| {first}, {second} | {CELL} each | {what}: name `{name}` |"));
        assert!(at <= first);
        at = second + CELL;
    }
    assert_eq!(at, PAYLOAD_OFFSET as usize);
    page.holds(&format!("| {PAYLOAD_OFFSET} | n | payload, one blob |"));
    assert_eq!(slot[64..72], [&b"CMIT"[..], &check].concat());
    assert_eq!(slot[72..64 + CELL], [0xFF; 24]);
    page.holds("A mark has two cells of 32 bytes");
    page.holds("the CRC-32 of the header (its bytes 60 to 63), and 24 bytes FF | set |");
    page.holds("| 32 bytes FF | erased |");
    page.holds("Program its first 8 bytes, or its first write unit if that is larger.");
    page.holds("the length is 0 or larger than the room");
    page.holds("Note the generation: 1 more than the larger one");
    page.holds("Program the 64 bytes of the header");
    page.holds(&format!(
        "sequence number {SEQUENCE}, generation 1, in a slot on a flash with words of 4 bytes"
    ));
    // slots_boot_as_specified
    let begin = page.text.find(DECISIONS).unwrap();
    let end = begin + page.text[begin..].find("\n\n").unwrap();
    page.checked.push(begin..end);
    page.finish();
}

#[test]
fn a_unit_that_cannot_be_read_counts_as_specified() {
    let mut memory = Memory::<4, SLOT>::new(2 * SLOT);
    install(&mut boot(&mut memory).0);
    boot(&mut memory).0.confirm().unwrap();
    let (runs, rests) = (Which::A, Which::Factory);
    let of_cells = MARKS.into_iter().flat_map(|(name, at)| {
        let running = if name == "RJCT" { rests } else { runs };
        [(at, running), (at + CELL, running)]
    });
    for (at, running) in of_cells.chain([(0, rests), (60, rests), (320, rests), (324, rests)]) {
        // The driver reports it, or hands out zeros.
        for reports in [true, false] {
            let mut memory = Memory { reports, ..memory.clone() };
            memory.broken.insert(at / 4);
            let before = memory.bytes.clone();
            let (_, found) = boot(&mut memory);
            assert_eq!(found.running, running, "at {at}");
            let refusal = (running == rests).then_some(Refusal::Flash(Failed));
            if reports {
                assert_eq!((found.refused[0], memory.bytes == before), (refusal, true), "at {at}");
            }
        }
    }
}
