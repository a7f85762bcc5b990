//! The short form of fuzzing: the corpora of `fuzz/corpus`, their neighbours, and bytes at random.

mod targets;

use std::path::PathBuf;

/// xorshift64*: bytes at random without a dependency, the same every time.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }
}

fn corpus(name: &str) -> Vec<Vec<u8>> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus").join(name);
    let mut files: Vec<_> =
        std::fs::read_dir(&folder).expect("the corpus is there").map(|f| f.expect("entry").path()).collect();
    files.sort();
    assert!(!files.is_empty(), "{}", folder.display());
    files.iter().map(|f| std::fs::read(f).expect("readable")).collect()
}

fn run(name: &str, target: fn(&[u8]), neighbours: usize) {
    let mut random = Random(0x9e37_79b9_7f4a_7c15);
    for seed in corpus(name) {
        target(&seed);
        for _ in 0..neighbours {
            let mut bytes = seed.clone();
            for _ in 0..1 + random.next() % 4 {
                let at = random.next() as usize % (bytes.len() + 1);
                match random.next() % 3 {
                    0 => bytes.insert(at, random.next() as u8),
                    1 if at < bytes.len() => drop(bytes.remove(at)),
                    _ if at < bytes.len() => bytes[at] ^= 1 << (random.next() % 8),
                    _ => {}
                }
            }
            target(&bytes);
        }
    }
    for length in 0..neighbours {
        let bytes: Vec<u8> = (0..length % 300).map(|_| random.next() as u8).collect();
        target(&bytes);
    }
}

#[test]
fn framing() {
    run("framing", targets::framing, 400);
}

#[test]
fn requests() {
    run("requests", targets::requests, 300);
}

#[test]
fn program() {
    run("program", targets::program, 300);
}

#[test]
fn stream() {
    run("stream", targets::stream, 300);
}

#[test]
fn flash() {
    run("flash", targets::flash, 300);
}
