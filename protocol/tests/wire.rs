//! Framing: round trips, chunking, noise.

mod common;

use common::{config, reply, request};
use daic_protocol::frame::*;
use daic_protocol::limits::CHUNK_LEN;
use daic_protocol::message::*;
use proptest::collection::vec;
use proptest::prelude::*;

type Got = (u32, Request);

/// Everything the decoder says about a stream of bytes.
fn receive(stream: &[u8]) -> (Vec<Got>, Rejected) {
    let mut decoder = Decoder::new();
    let mut got = Vec::new();
    for &byte in stream {
        if let Fed::Message { id, message, .. } = decoder.feed_request(byte) {
            got.push((id, message));
        }
    }
    (got, decoder.rejected)
}

fn total(r: &Rejected) -> u32 {
    r.oversized + r.cobs + r.length + r.crc + r.header + r.body
}

fn stream_of(sent: &[Got]) -> Vec<u8> {
    sent.iter().flat_map(|(id, r)| encode_request(*id, r).unwrap()).collect()
}

/// Messages of every length class: empty body, short, with zeros, longer than one COBS block.
fn typical() -> Vec<Got> {
    let chunk =
        |index, byte: fn(usize) -> u8, n| Request::LoadChunk { index, data: (0..n).map(byte).collect() };
    vec![
        (1, Request::Hello),
        (2, Request::LoadBegin { length: 481 }),
        (3, chunk(0, |i| i as u8, CHUNK_LEN)),
        (4, chunk(1, |_| 0, CHUNK_LEN)),
        (0x0102_0304, chunk(2, |_| 0xff, 1)),
        (6, Request::LoadCommit { length: 481, hash: 0xdead_beef }),
        (7, Request::Arm { hash: 0xdead_beef }),
        (8, Request::Start),
        (9, Request::Abort),
    ]
}

/// Whatever comes out must have been sent, each message at most as often as it was.
fn assert_only_sent(got: &[Got], sent: &[Got], what: &str) {
    let mut left = sent.to_vec();
    for g in got {
        let at = left.iter().position(|s| s == g).unwrap_or_else(|| panic!("{what}: got {g:?}, never sent"));
        left.remove(at);
    }
}

#[test]
fn every_single_bit_flip_is_caught() {
    let sent = typical();
    let stream = stream_of(&sent);
    for bit in 0..stream.len() * 8 {
        let mut bad = stream.clone();
        bad[bit / 8] ^= 1 << (bit % 8);
        let (got, rejected) = receive(&bad);
        assert_only_sent(&got, &sent, &format!("bit {bit}"));
        // A flip costs one message, or two when it hits a delimiter; and it is noticed.
        assert!(got.len() + 2 >= sent.len() && got.len() < sent.len(), "bit {bit}: {} messages", got.len());
        // Only the last delimiter's loss leaves the frame open and nothing counted yet.
        assert!(total(&rejected) >= 1 || bit / 8 == stream.len() - 1, "bit {bit} went unnoticed");
    }
}

#[test]
fn every_lost_byte_is_caught() {
    let sent = typical();
    let stream = stream_of(&sent);
    for at in 0..stream.len() {
        let mut bad = stream.clone();
        bad.remove(at);
        let (got, rejected) = receive(&bad);
        assert_only_sent(&got, &sent, &format!("byte {at}"));
        assert!(got.len() < sent.len());
        if stream[at] == 0 && at + 1 < stream.len() {
            assert_eq!(got.len(), sent.len() - 2, "a lost delimiter at {at} costs both messages");
        }
        assert!(total(&rejected) >= 1 || at == stream.len() - 1, "byte {at} went unnoticed");
    }
}

#[test]
fn every_doubled_byte_is_caught() {
    let sent = typical();
    let stream = stream_of(&sent);
    for at in 0..stream.len() {
        let mut bad = stream.clone();
        bad.insert(at, stream[at]);
        let (got, rejected) = receive(&bad);
        assert_only_sent(&got, &sent, &format!("byte {at}"));
        if stream[at] == 0 {
            assert_eq!((got.len(), total(&rejected)), (sent.len(), 0), "an empty frame is no error");
        } else {
            // In a run of equal bytes doubling one or the other is the same stream; it is longer all the same.
            assert_eq!(got.len(), sent.len() - 1, "byte {at}");
            assert!(total(&rejected) >= 1);
        }
    }
}

#[test]
fn an_overlong_frame_is_dropped_whole() {
    // The tail of the noise is a valid frame's content: it must not be taken for one.
    let inner = encode_request(77, &Request::Start).unwrap();
    for noise in [MAX_FRAME, MAX_FRAME + 1, 4 * MAX_FRAME, 64 * 1024] {
        let mut stream = vec![1u8; noise];
        stream.extend_from_slice(&inner);
        stream.extend_from_slice(&encode_request(78, &Request::Stop).unwrap());
        let (got, rejected) = receive(&stream);
        assert_eq!(got, [(78, Request::Stop)]);
        assert_eq!(rejected, Rejected { oversized: 1, ..Rejected::default() });
    }
}

#[test]
fn rejections_are_counted_by_cause() {
    /// A frame round a hand-made payload.
    fn wrap(payload: &[u8]) -> Vec<u8> {
        let mut out = vec![0u8; payload.len() + payload.len() / 254 + 1];
        let n = cobs::encode(payload, &mut out);
        out.truncate(n);
        out.push(0);
        out
    }
    fn sealed(mut head: Vec<u8>) -> Vec<u8> {
        head.extend_from_slice(&crc32(&head).to_le_bytes());
        wrap(&head)
    }
    let request = |length: u8, body: &[u8]| [&[1, 1, length, 0, 7, 0, 0, 0], body].concat();
    let none = Rejected::default();
    let cases: [(&str, Vec<u8>, Rejected); 9] = [
        ("five bytes announced, one there", vec![5, 1, 0], Rejected { cobs: 1, ..none }),
        (
            "shorter than header and CRC",
            wrap(&[1, 1, 0, 0, 7, 0, 0, 0, 1, 2, 3]),
            Rejected { length: 1, ..none },
        ),
        ("header says two, one there", sealed(request(2, &[0])), Rejected { length: 1, ..none }),
        ("CRC", wrap(&[request(1, &[0]), vec![1, 2, 3, 4]].concat()), Rejected { crc: 1, ..none }),
        ("kind", sealed(vec![1, 9, 1, 0, 7, 0, 0, 0, 0]), Rejected { header: 1, ..none }),
        ("version", sealed(vec![2, 1, 1, 0, 7, 0, 0, 0, 1]), Rejected { header: 1, ..none }),
        ("no such request", sealed(request(1, &[200])), Rejected { body: 1, ..none }),
        ("a byte left over", sealed(request(2, &[0, 0])), Rejected { body: 1, ..none }),
        ("empty body", sealed(request(0, &[])), Rejected { body: 1, ..none }),
    ];
    for (what, stream, expected) in cases {
        assert_eq!(receive(&stream), (vec![], expected), "{what}");
    }
    assert_eq!(
        receive(&sealed(request(1, &[0]))),
        (vec![(7, Request::Hello)], none),
        "the hand-made frame is right"
    );
    assert_eq!(receive(&[0, 0, 0]), (vec![], none), "empty frames");
}

proptest! {
    #![proptest_config(config(256))]

    /// Requests, replies: what goes in comes out, byte for byte when encoded again.
    #[test]
    fn encode_decode_encode(id: u32, r in request(), p in reply()) {
        let frame = encode_request(id, &r).unwrap();
        prop_assert_eq!(frame.iter().filter(|&&b| b == 0).count(), 1);
        let mut d = Decoder::new();
        let last = frame.iter().map(|&b| d.feed_request(b)).last().unwrap();
        let Fed::Message { id: got, message, crc } = last else { panic!("{last:?}") };
        prop_assert_eq!((got, &message), (id, &r));
        prop_assert_eq!(encode_request(got, &message).unwrap(), frame.clone());
        let mut raw = frame[..frame.len() - 1].to_vec();
        let n = cobs::decode_in_place(&mut raw).unwrap();
        prop_assert_eq!(&crc.to_le_bytes()[..], &raw[n - 4..n], "the CRC told is the frame's");

        let frame = encode_reply(id, &p).unwrap();
        let last = frame.iter().map(|&b| d.feed_reply(b)).last().unwrap();
        let Fed::Message { id: got, message, .. } = last else { panic!("{last:?}") };
        prop_assert_eq!((got, &message), (id, &p));
        prop_assert_eq!(encode_reply(got, &message).unwrap(), frame);
        prop_assert_eq!(d.rejected, Rejected::default());
    }

    /// Our COBS is everybody's COBS.
    #[test]
    fn cobs_agrees_with_the_reference(index: u16, data in vec(prop_oneof![2 => Just(1u8), 1 => any::<u8>()], 0..=CHUNK_LEN)) {
        let frame = encode_request(3, &Request::LoadChunk { index, data: data.into_iter().collect() }).unwrap();
        let mut raw = frame[..frame.len() - 1].to_vec();
        let n = cobs::decode_in_place(&mut raw).unwrap();
        let mut again = vec![0; MAX_FRAME];
        let m = cobs::encode(&raw[..n], &mut again);
        prop_assert_eq!(&again[..m], &frame[..frame.len() - 1]);
    }

    /// Where the stream is cut does not matter, nor what a read leaves for the next.
    #[test]
    fn any_chunking_gives_the_same_frames(
        sent in vec((any::<u32>(), request()), 0..6),
        noise in vec(any::<u8>(), 0..40),
        cuts in vec(0usize..80, 0..60),
    ) {
        let mut stream = stream_of(&sent);
        stream.extend_from_slice(&noise);
        stream.push(0);
        stream.extend(stream_of(&sent));
        let whole = receive(&stream);
        let mut decoder = Decoder::new();
        let mut got = Vec::new();
        let mut rest = &stream[..];
        for cut in cuts.into_iter().chain([usize::MAX]) {
            let (now, later) = rest.split_at(cut.min(rest.len()));
            rest = later;
            for &b in now {
                if let Fed::Message { id, message, .. } = decoder.feed_request(b) {
                    got.push((id, message));
                }
            }
        }
        prop_assert_eq!((got, decoder.rejected), whole.clone());
        prop_assert_eq!(&whole.0[..sent.len()], &sent[..]);
        prop_assert_eq!(&whole.0[whole.0.len() - sent.len()..], &sent[..]);
    }

    /// One fault anywhere in a random stream: nothing comes out that was not sent.
    #[test]
    fn one_fault_yields_no_foreign_command(
        sent in vec((any::<u32>(), request()), 1..5), at: prop::sample::Index, bit in 0u8..8, how in 0u8..3,
    ) {
        let mut stream = stream_of(&sent);
        let at = at.index(stream.len());
        match how {
            0 => stream[at] ^= 1 << bit,
            1 => { stream.remove(at); }
            _ => stream.insert(at, stream[at]),
        }
        stream.push(0);
        let (got, _) = receive(&stream);
        assert_only_sent(&got, &sent, "fault");
        prop_assert!(got.len() + 2 >= sent.len());
    }

    /// Random bytes: no panic, no message, every frame accounted for.
    #[test]
    fn random_bytes_are_survived(bytes in vec(prop_oneof![4 => any::<u8>(), 1 => Just(0u8)], 0..2000)) {
        let (got, rejected) = receive(&bytes);
        prop_assert_eq!(got, vec![]);
        let frames = bytes.split_inclusive(|&b| b == 0).filter(|f| f.len() > 1 && f.ends_with(&[0])).count();
        prop_assert!(total(&rejected) as usize >= frames);
        let mut d = Decoder::new();
        for b in bytes {
            let is_message = matches!(d.feed_reply(b), Fed::Message { .. });
            prop_assert!(!is_message);
        }
    }

    /// Random bodies in sound frames: decoded or rejected, never a panic; what decodes, encodes again
    /// to a message that is equal.
    #[test]
    fn random_bodies_are_survived(body in vec(any::<u8>(), 0..64)) {
        let mut payload = vec![1, 1, body.len() as u8, 0, 1, 2, 3, 4];
        payload.extend_from_slice(&body);
        payload.extend_from_slice(&crc32(&payload).to_le_bytes());
        let mut frame = vec![0; MAX_FRAME];
        let n = cobs::encode(&payload, &mut frame);
        frame.truncate(n);
        frame.push(0);
        let (got, rejected) = receive(&frame);
        prop_assert_eq!(got.len() as u32 + total(&rejected), 1);
        prop_assert_eq!(total(&rejected), rejected.body);
        if let Some((id, message)) = got.first() {
            prop_assert_eq!(receive(&encode_request(*id, message).unwrap()).0, got.clone());
        }
    }
}
