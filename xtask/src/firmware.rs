//! The image for the Pico: built, gated, as ELF and UF2.

use crate::steps::{Outcome, cargo, root};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Flash that program and constants may take.
const MAX_FLASH: u32 = 224 * 1024;
/// RAM that variables may take: more than 100 KiB stay for the stack.
const MAX_RAM: u32 = 160 * 1024;
/// Panics that may be reached from somewhere in the image, by what the symbol's name begins with. None of
/// them has a known cause; each ends with all outputs off.
const PANICS: &str = include_str!("../../firmware/boards/pico/panics.txt");

/// Where the images are put.
pub fn directory() -> PathBuf {
    root().join("target/firmware")
}

/// The image as ELF.
pub fn elf() -> PathBuf {
    directory().join("daic-pico.elf")
}

/// Environment of a compiler for the Pico's core: rustup's target, or one brought into `target/thumb`.
fn toolchain() -> Result<Vec<(String, String)>, Outcome> {
    let script = root().join("ci/thumb-toolchain.sh");
    let output = Command::new("bash")
        .arg(&script)
        .stderr(Stdio::inherit())
        .output()
        .map_err(|error| Outcome::NotRun(format!("bash did not start: {error}")))?;
    if !output.status.success() {
        return Err(Outcome::NotRun(format!(
            "no Rust toolchain for thumbv6m-none-eabi could be had ({}); `rustup target add thumbv6m-none-eabi` brings one",
            output.status
        )));
    }
    let text = String::from_utf8_lossy(&output.stdout);
    let exports = text.lines().filter_map(|line| line.strip_prefix("export "));
    let pairs = exports.flat_map(str::split_whitespace).filter_map(|pair| pair.split_once('='));
    Ok(pairs.map(|(name, value)| (name.to_owned(), value.to_owned())).collect())
}

/// Builds the image, writes ELF and UF2, checks size and panics.
pub fn build() -> Outcome {
    let environment = match toolchain() {
        Ok(environment) => environment,
        Err(outcome) => return outcome,
    };
    // A directory of its own: the compiler may be another than the one that built the rest.
    let target = root().join("target/pico");
    let manifest = root().join("firmware/boards/pico/Cargo.toml");
    let mut build =
        cargo(&["build", "--locked", "--release", "--target", "thumbv6m-none-eabi", "--manifest-path"]);
    build.arg(manifest).env("CARGO_TARGET_DIR", &target).envs(environment);
    match build.status() {
        Ok(status) if status.success() => {}
        Ok(status) => return Outcome::Failed(status.to_string()),
        Err(error) => return Outcome::Failed(format!("cargo did not start: {error}")),
    }
    match finish(&target.join("thumbv6m-none-eabi/release/daic-pico")) {
        Ok(()) => Outcome::Passed,
        Err(error) => Outcome::Failed(error),
    }
}

fn finish(built: &Path) -> Result<(), String> {
    let bytes = std::fs::read(built).map_err(|error| format!("{}: {error}", built.display()))?;
    let image = Elf::parse(&bytes).ok_or("the image is not a 32-bit ELF file")?;
    let sizes = image.sizes();
    println!("flash {} bytes, RAM {} bytes (variables)", sizes.flash, sizes.ram);
    std::fs::create_dir_all(directory()).map_err(|error| error.to_string())?;
    put(&elf(), &bytes)?;
    put(&directory().join("daic-pico.uf2"), &uf2(&image.flash())?)?;
    println!("{}\n{}", elf().display(), directory().join("daic-pico.uf2").display());
    if sizes.flash > MAX_FLASH || sizes.ram > MAX_RAM {
        return Err(format!("too large: at most {MAX_FLASH} bytes of flash and {MAX_RAM} of RAM"));
    }
    let known: Vec<&str> = PANICS.lines().filter(|line| !line.is_empty() && !line.starts_with('#')).collect();
    let panics = image.panics();
    println!("{} panics can be reached: {}", panics.len(), panics.join(", "));
    let unknown: Vec<&String> = panics.iter().filter(|name| !known.contains(&name.as_str())).collect();
    if !unknown.is_empty() {
        return Err(format!("panics that are not in firmware/boards/pico/panics.txt: {unknown:?}"));
    }
    Ok(())
}

/// Written beside and renamed, so that nobody ever sees half a file.
pub fn put(path: &Path, bytes: &[u8]) -> Result<(), String> {
    let beside = path.with_extension("new");
    std::fs::write(&beside, bytes)
        .and_then(|()| std::fs::rename(&beside, path))
        .map_err(|error| format!("{}: {error}", path.display()))
}

/// Sizes of an image in bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sizes {
    /// In flash: program, constants, initial values.
    pub flash: u32,
    /// In RAM: variables.
    pub ram: u32,
}

/// A 32-bit little-endian ELF file.
pub struct Elf<'a> {
    bytes: &'a [u8],
}

const FLASH: std::ops::Range<u32> = 0x1000_0000..0x1100_0000;
const RAM: std::ops::Range<u32> = 0x2000_0000..0x2004_2000;

impl<'a> Elf<'a> {
    /// `None` if it is no such file.
    pub fn parse(bytes: &'a [u8]) -> Option<Self> {
        (bytes.get(..6)? == b"\x7fELF\x01\x01").then_some(Self { bytes })
    }

    fn word(&self, at: usize) -> u32 {
        self.bytes.get(at..at + 4).map_or(0, |w| u32::from_le_bytes([w[0], w[1], w[2], w[3]]))
    }

    fn half(&self, at: usize) -> usize {
        self.word(at) as usize & 0xffff
    }

    /// Program headers that are loaded: (offset, virtual address, physical address, file size, memory size).
    fn segments(&self) -> impl Iterator<Item = [u32; 5]> {
        let table = self.word(28) as usize;
        (0..self.half(44))
            .map(move |i| table + 32 * i)
            .filter(|&at| self.word(at) == 1)
            .map(|at| [4, 8, 12, 16, 20].map(|offset| self.word(at + offset)))
    }

    /// Bytes in flash: (address, bytes), in order of addresses.
    pub fn flash(&self) -> Vec<(u32, &'a [u8])> {
        let mut parts: Vec<_> = self
            .segments()
            .filter(|[_, _, physical, size, _]| FLASH.contains(physical) && *size > 0)
            .filter_map(|[offset, _, physical, size, _]| {
                Some((physical, self.bytes.get(offset as usize..(offset + size) as usize)?))
            })
            .collect();
        parts.sort_by_key(|part| part.0);
        parts
    }

    /// How much it takes.
    pub fn sizes(&self) -> Sizes {
        let flash = self.flash().iter().map(|(_, bytes)| bytes.len() as u32).sum();
        let ram = self.segments().filter(|s| RAM.contains(&s[1])).map(|s| s[4]).sum();
        Sizes { flash, ram }
    }

    /// Functions through which a panic goes, by their last two names without hash.
    pub fn panics(&self) -> Vec<String> {
        let table = self.word(32) as usize;
        let sections = (0..self.half(48)).map(|i| table + 40 * i);
        let mut names = std::collections::BTreeSet::new();
        for section in sections.filter(|&at| self.word(at + 4) == 2) {
            let (offset, size) = (self.word(section + 16) as usize, self.word(section + 20) as usize);
            let strings = table + 40 * self.word(section + 24) as usize;
            let strings = self.word(strings + 16) as usize;
            for symbol in (offset..offset + size).step_by(16) {
                let function = self.word(symbol + 12) & 0xf == 2;
                let name = self.bytes.get(strings + self.word(symbol) as usize..).unwrap_or(&[]);
                let name: Vec<u8> = name.iter().copied().take_while(|&b| b != 0).collect();
                let name = String::from_utf8_lossy(&name);
                if function && ["panic", "_fail"].iter().any(|word| name.contains(word)) {
                    names.insert(readable(&name));
                }
            }
        }
        names.into_iter().collect()
    }
}

/// The path of a mangled name: the identifiers with their lengths, without hashes.
fn readable(mangled: &str) -> String {
    let mut parts: Vec<&str> = Vec::new();
    let mut rest = mangled;
    while let Some(start) = rest.find(|c: char| c.is_ascii_digit()) {
        rest = &rest[start..];
        let digits = rest.find(|c: char| !c.is_ascii_digit()).unwrap_or(rest.len());
        let length: usize = rest[..digits].parse().unwrap_or(0);
        // The newer mangling puts `_` before a name that begins with a digit or `_`.
        let body =
            rest[digits..].strip_prefix('_').filter(|_| mangled.starts_with("_R")).unwrap_or(&rest[digits..]);
        let is_name = length > 1
            && body
                .get(..length)
                .is_some_and(|n| n.chars().all(|c| c.is_ascii_alphanumeric() || "_$.".contains(c)));
        if is_name {
            let name = &body[..length];
            let hash = name.len() == 17 && name.starts_with('h');
            if !hash {
                parts.push(name);
            }
            rest = &body[length..];
        } else {
            rest = &rest[digits..];
        }
    }
    let from = parts.len().saturating_sub(2);
    if parts.is_empty() { mangled.to_owned() } else { parts[from..].join("::") }
}

/// Bytes of flash as a UF2 file for the RP2040: blocks of 256 bytes, each in 512 bytes of file.
fn uf2(parts: &[(u32, &[u8])]) -> Result<Vec<u8>, String> {
    let mut pages = std::collections::BTreeMap::<u32, [u8; 256]>::new();
    for (address, bytes) in parts {
        for (at, byte) in (*address..).zip(*bytes) {
            pages.entry(at & !0xff).or_insert([0; 256])[(at & 0xff) as usize] = *byte;
        }
    }
    let count = u32::try_from(pages.len()).map_err(|error| error.to_string())?;
    let mut file = Vec::with_capacity(512 * pages.len());
    for (number, (address, page)) in (0u32..).zip(&pages) {
        let head = [0x0a32_4655, 0x9e5d_5157, 0x2000, *address, 256, number, count, 0xe48b_ff56];
        file.extend(head.iter().flat_map(|word| word.to_le_bytes()));
        file.extend_from_slice(page);
        file.resize(file.len() + 476 - 256, 0);
        file.extend_from_slice(&0x0ab1_6f30_u32.to_le_bytes());
    }
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Layout and numbers of the format's specification.
    #[test]
    fn uf2_blocks() {
        let bytes: Vec<u8> = (0..300).map(|i| i as u8).collect();
        let file =
            uf2(&[(0x1000_0000, &bytes[..256]), (0x1000_0100, &bytes[256..]), (0x1000_1010, &[7])]).unwrap();
        assert_eq!(file.len(), 3 * 512);
        let word = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap());
        for (block, address) in [(0, 0x1000_0000), (1, 0x1000_0100), (2, 0x1000_1000)] {
            let at = 512 * block;
            assert_eq!(&file[at..at + 4], b"UF2\n");
            assert_eq!(word(at + 4), 0x9e5d_5157);
            assert_eq!(word(at + 8), 0x2000, "a family id is given");
            assert_eq!((word(at + 12), word(at + 16)), (address, 256));
            assert_eq!((word(at + 20), word(at + 24)), (block as u32, 3));
            assert_eq!(word(at + 28), 0xe48b_ff56, "RP2040");
            assert_eq!(word(at + 508), 0x0ab1_6f30);
        }
        assert_eq!(&file[32..288], &bytes[..256]);
        assert_eq!(file[512 + 32 + 43], 43);
        assert_eq!(file[1024 + 32 + 0x10], 7);
    }

    #[test]
    fn names_are_readable() {
        assert_eq!(readable("_ZN4core9panicking9panic_fmt17h0123456789abcdefE"), "panicking::panic_fmt");
        assert_eq!(
            readable("_RNvNtCsabc_4core9panicking18panic_bounds_check"),
            "panicking::panic_bounds_check"
        );
        assert_eq!(readable("rust_begin_unwind"), "rust_begin_unwind");
    }
}
