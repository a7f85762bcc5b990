//! Lists of image files: folders and patterns, in the order in which people count.

use crate::error::Error;
use std::cmp::Ordering;
use std::path::{Path, PathBuf};

/// Endings of image files that can be read.
const ENDINGS: [&str; 4] = ["tif", "tiff", "png", "bmp"];

/// Whether `given` stands for any number of files: a folder, or a pattern with `*`, `?` or `[`.
pub fn is_many(given: &Path) -> bool {
    given.is_dir() || (!given.exists() && given.to_string_lossy().contains(['*', '?', '[']))
}

/// The files that `given` stands for: folders and patterns in natural order (`f2` before `f10`),
/// without the reference; everything else as it stands, whether it exists or not.
///
/// # Errors
/// [`Error::NoFrameFiles`] for a folder or a pattern without images, [`Error::Pattern`],
/// [`Error::Read`] for a folder that cannot be listed.
pub fn expand(given: &[PathBuf], reference: &Path) -> Result<Vec<PathBuf>, Error> {
    let mut all = Vec::new();
    for path in given {
        if !is_many(path) {
            all.push(path.clone());
            continue;
        }
        let mut files = if path.is_dir() { listed(path)? } else { matching(path)? };
        let same = |file: &Path| match (file.canonicalize(), reference.canonicalize()) {
            (Ok(a), Ok(b)) => a == b,
            _ => file == reference,
        };
        files.retain(|file| !same(file));
        if files.is_empty() {
            return Err(Error::NoFrameFiles { path: path.clone() });
        }
        files.sort_by(|a, b| natural(&a.to_string_lossy(), &b.to_string_lossy()));
        all.append(&mut files);
    }
    Ok(all)
}

/// The images in a folder, in no order.
pub(crate) fn listed(folder: &Path) -> Result<Vec<PathBuf>, Error> {
    let read = |source| Error::Read { path: folder.to_owned(), source };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(read)? {
        let path = entry.map_err(read)?.path();
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        if ending.is_some_and(|e| ENDINGS.contains(&e.as_str())) && !path.is_dir() {
            files.push(path);
        }
    }
    Ok(files)
}

fn matching(pattern: &Path) -> Result<Vec<PathBuf>, Error> {
    let found = glob::glob(&pattern.to_string_lossy())
        .map_err(|error| Error::Pattern { path: pattern.to_owned(), reason: error.msg.to_owned() })?;
    // what cannot be looked into is no match
    Ok(found.flatten().filter(|path| !path.is_dir()).collect())
}

/// Runs of digits compare as numbers, all else character by character.
fn natural(a: &str, b: &str) -> Ordering {
    let (mut a_rest, mut b_rest) = (a, b);
    loop {
        let (Some(x), Some(y)) = (a_rest.chars().next(), b_rest.chars().next()) else {
            // equal but for zeros in front: any fixed order
            return a_rest.len().cmp(&b_rest.len()).then_with(|| a.cmp(b));
        };
        if x.is_ascii_digit() && y.is_ascii_digit() {
            let (m, n) = (digits(&mut a_rest), digits(&mut b_rest));
            match m.len().cmp(&n.len()).then_with(|| m.cmp(n)) {
                Ordering::Equal => {}
                order => return order,
            }
        } else if x == y {
            a_rest = &a_rest[x.len_utf8()..];
            b_rest = &b_rest[y.len_utf8()..];
        } else {
            return x.cmp(&y);
        }
    }
}

/// Takes the digits in front off `text`; without zeros in front.
fn digits<'a>(text: &mut &'a str) -> &'a str {
    let end = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let (number, rest) = text.split_at(end);
    *text = rest;
    number.trim_start_matches('0')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn people_count_this_way() {
        let mut names = ["f10.tif", "f2.tif", "f1.tif", "e3.tif", "f02b.tif", "f.tif", "f002.tif", "ä1", "ä"];
        names.sort_by(|a, b| natural(a, b));
        assert_eq!(
            names,
            ["e3.tif", "f.tif", "f1.tif", "f002.tif", "f2.tif", "f02b.tif", "f10.tif", "ä", "ä1"]
        );
    }
}
