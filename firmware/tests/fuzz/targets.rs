//! What must hold for any bytes. Used by the targets in `fuzz/` and by the plain test beside this file.

use daic_firmware::slots::{Flash, PAGE, SECTOR, Slots, size};
use daic_firmware::verifier::verify;
use daic_firmware::{Board, Controller, Sink};
use daic_protocol::channels::{INTERLOCK, TRIGGER_INPUT_MASK};
use daic_protocol::frame::{Decoder, Fed, encode_request};
use daic_protocol::limits::{CHUNK_LEN, MIN_STEP_TICKS};
use daic_protocol::message::{Reply, Request, State};
use daic_protocol::program;

/// Checks what is put out: words in order, no two too close, LEDs never beyond what any row allows.
#[derive(Default)]
struct Checked {
    last: Option<u64>,
    word: u32,
    lit: [Option<u64>; 8],
    words: usize,
}

impl Sink for Checked {
    fn word(&mut self, tick: u64, word: u32) {
        if let Some(last) = self.last {
            assert!(tick >= last + u64::from(MIN_STEP_TICKS), "{last} and {tick}");
        }
        self.last = Some(tick);
        self.word = word;
        self.words += 1;
        for (i, lit) in self.lit.iter_mut().enumerate() {
            match (word >> i & 1 == 1, *lit) {
                (true, None) => *lit = Some(tick),
                (false, Some(since)) => {
                    assert!(tick - since <= 1_250_000 + u64::from(MIN_STEP_TICKS), "LED {i}");
                    *lit = None;
                }
                _ => {}
            }
        }
    }
    fn level(&mut self, _: u64, _: u8, _: u16) {}
}

/// Any bytes, cut anywhere, give the same messages and rejections.
pub fn framing(data: &[u8]) {
    let feed = |decoder: &mut Decoder, bytes: &[u8]| {
        let fed = bytes.iter().map(|&byte| decoder.feed_request(byte));
        fed.filter(|fed| *fed != Fed::Pending).collect::<Vec<_>>()
    };
    let mut whole = Decoder::new();
    let expected = feed(&mut whole, data);
    for fed in &expected {
        // What is understood is what somebody may have sent.
        if let Fed::Message { id, message, .. } = fed {
            let frame = encode_request(*id, message).expect("a request fits a frame");
            let again = feed(&mut Decoder::new(), &frame);
            assert!(matches!(again.as_slice(), [Fed::Message { message: m, .. }] if m == message));
        }
    }
    let (first, second) = data.split_at(data.len() / 2);
    let mut cut = Decoder::new();
    let mut found = feed(&mut cut, first);
    found.extend(feed(&mut cut, second));
    assert_eq!(found, expected);
    assert_eq!(cut.rejected, whole.rejected);
    let mut replies = Decoder::new();
    for &byte in data {
        let _ = replies.feed_reply(byte);
    }
}

fn board() -> Board {
    let mut board = Board::reference();
    board.capabilities = daic_firmware::PLAYED;
    board
}

/// Requests of any kind in any order: each is a line of bytes (first its length); between them time passes and
/// inputs change.
pub fn requests(data: &[u8]) {
    let mut controller = Controller::new(board(), 7);
    let mut out = Checked::default();
    let (mut now, mut id) = (1000u64, 0u32);
    let mut rest = data;
    while let [length, ticks, tail @ ..] = rest {
        let (body, after) = tail.split_at(usize::from(*length).min(tail.len()));
        rest = after;
        now += u64::from(*ticks) * u64::from(*ticks) * 1000;
        if ticks % 4 == 1 {
            let input = (u32::from(*ticks) & TRIGGER_INPUT_MASK) | if ticks % 8 == 1 { 0 } else { INTERLOCK };
            controller.inputs(now, input, &mut out);
        }
        let Ok((request, _)) = take(body) else { continue };
        id += 1;
        let Ok(frame) = encode_request(id, &request) else { continue };
        let mut replies = 0;
        let mut decoder = Decoder::new();
        controller.receive(now, &frame, &mut out, &mut |bytes| {
            for &byte in bytes {
                replies += usize::from(matches!(decoder.feed_reply(byte), Fed::Message { .. }));
            }
        });
        assert_eq!(replies, 1, "{request:?}");
        if matches!(controller.state(), State::Faulted | State::Loaded | State::Empty) {
            assert_eq!(controller.word(), 0);
        }
        // An endless program must not hold up the search.
        if out.words > 50_000 {
            return;
        }
    }
}

fn take(body: &[u8]) -> Result<(Request, usize), ()> {
    postcard::take_from_bytes::<Request>(body).map(|(r, rest)| (r, body.len() - rest.len())).map_err(drop)
}

/// Any bytes as a program: a verdict; what is accepted is played to its end, or for a while, and keeps the rules.
pub fn program(data: &[u8]) {
    let board = board();
    if verify(data, &board).is_err() {
        return;
    }
    let mut controller = Controller::new(board, 7);
    let mut out = Checked::default();
    let ask = |controller: &mut Controller, out: &mut Checked, now: u64, id: u32, request: &Request| {
        let frame = encode_request(id, request).expect("fits");
        let mut done = false;
        let mut decoder = Decoder::new();
        controller.receive(now, &frame, out, &mut |bytes| {
            for &byte in bytes {
                done |= matches!(decoder.feed_reply(byte), Fed::Message { message: Reply::Done { .. }, .. });
            }
        });
        done
    };
    let length = data.len() as u32;
    let hash = program::hash(data);
    let mut id = 1;
    let mut all = vec![Request::LoadBegin { length }];
    for (index, chunk) in data.chunks(CHUNK_LEN).enumerate() {
        all.push(Request::LoadChunk { index: index as u16, data: chunk.iter().copied().collect() });
    }
    all.push(Request::LoadCommit { length, hash });
    all.push(Request::Arm { hash });
    controller.inputs(1000, INTERLOCK, &mut out);
    for request in &all {
        id += 1;
        assert!(ask(&mut controller, &mut out, 1000, id, request), "{request:?}");
    }
    if !ask(&mut controller, &mut out, 1000, id + 1, &Request::Start) {
        return;
    }
    let mut steps = 0;
    while let Some(due) = controller.next_due() {
        controller.play(due, &mut out);
        steps += 1;
        if steps > 20_000 {
            return;
        }
    }
    if controller.state() != State::Running {
        assert_eq!((controller.word(), out.word), (0, 0));
        // Only an input, or the lack of one, may end a proven program badly.
        if let Some(fault) = controller.fault() {
            use daic_protocol::message::FaultCause as Cause;
            let fine = matches!(
                fault.cause,
                Cause::TriggerTimeout { .. } | Cause::HomingFailed { .. } | Cause::HostLost
            );
            assert!(fine, "{fault:?}");
        }
    }
}

/// Any bytes as a stream in pieces: refused, or played within the rules to an under-run or an end.
pub fn stream(data: &[u8]) {
    let [piece, data @ ..] = data else { return };
    let piece = usize::from(*piece).clamp(1, CHUNK_LEN);
    let mut controller = Controller::new(board(), 7);
    let mut out = Checked::default();
    controller.inputs(1000, INTERLOCK, &mut out);
    let mut id = 0;
    let mut now = 1000;
    let mut send = |controller: &mut Controller, out: &mut Checked, now: u64, request: &Request| {
        id += 1;
        let frame = encode_request(id, request).expect("fits");
        controller.receive(now, &frame, out, &mut |_| {});
    };
    send(&mut controller, &mut out, now, &Request::StreamBegin);
    let mut offset = 0u32;
    for (i, chunk) in data.chunks(piece).enumerate() {
        let request = Request::StreamWrite { offset, data: chunk.iter().copied().collect() };
        send(&mut controller, &mut out, now, &request);
        offset += chunk.len() as u32;
        if i == 3 {
            send(&mut controller, &mut out, now, &Request::Start);
        }
        now += 100_000;
        controller.play(now, &mut out);
        if out.words > 20_000 {
            return;
        }
    }
    controller.play(now + 10_000_000, &mut out);
    if controller.state() == State::Faulted {
        assert_eq!(controller.word(), 0);
    }
}

/// Two slots of flash.
#[derive(Clone)]
struct Image(Vec<u8>);

impl Flash for Image {
    fn read(&self, offset: u32, into: &mut [u8]) {
        into.copy_from_slice(&self.0[offset as usize..][..into.len()]);
    }
    fn erase(&mut self, offset: u32) {
        self.0[offset as usize..][..SECTOR as usize].fill(0xff);
    }
    fn program(&mut self, offset: u32, page: &[u8; PAGE]) {
        self.0[offset as usize..].iter_mut().zip(page).for_each(|(to, from)| *to &= from);
    }
}

/// Flash in which bytes have changed since it was written: 4 bytes each, an offset and what stands there. What is
/// found in a slot is whole, and the slot can be written again; the other keeps what it has.
pub fn flash(data: &[u8]) {
    let mut slots = Slots::new(Image(vec![0xff; size(2) as usize]), 2);
    let long: Vec<u8> = (0..600u32).map(|i| (i * 7) as u8).collect();
    for (slot, bytes) in [(0, &long[..]), (0, &long[..300]), (1, &long[..40]), (1, &[])] {
        slots.store(slot, bytes, [slot, 0, 0, 0]).expect("good flash");
    }
    for change in data.chunks_exact(4) {
        let offset = u32::from_le_bytes([change[0], change[1], change[2], 0]) % size(2);
        slots.flash().0[offset as usize] = change[3];
    }
    let mut loaded = program::ProgramBytes::new();
    let held = |slots: &Slots<Image>, slot: u8, loaded: &mut program::ProgramBytes| {
        let stored = slots.load(slot, loaded).ok()?;
        assert_eq!(program::hash(loaded), stored.hash);
        assert_eq!(loaded.len(), stored.length as usize);
        Some(stored)
    };
    let (first, second) = (held(&slots, 0, &mut loaded), held(&slots, 1, &mut loaded));
    assert_eq!(slots.list().len(), usize::from(first.is_some()) + usize::from(second.is_some()));
    slots.store(0, &long[..77], [9; 4]).expect("good flash");
    assert_eq!(held(&slots, 1, &mut loaded), second);
    assert!(held(&slots, 0, &mut loaded).is_some_and(|stored| stored.tag == [9; 4]));
    assert_eq!(loaded, long[..77]);
    slots.erase(0).expect("good flash");
    assert_eq!((held(&slots, 0, &mut loaded), held(&slots, 1, &mut loaded)), (None, second));
}
