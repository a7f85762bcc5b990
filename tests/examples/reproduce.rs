//! Reproduces a chapter of the thesis and writes its part of `docs/reproduction.md`:
//! `reproduce macro|micro|lightfield [--quick] [DOCS]`.

use daic_tests::reproduce::{Extent, ReproduceError, document, lightfield, macroscopic, microscopic};
use std::path::PathBuf;
use std::process::ExitCode;

fn run(chapter: &str, extent: Extent, docs: &std::path::Path) -> Result<(), ReproduceError> {
    let part = match chapter {
        "macro" => macroscopic::part(&macroscopic::run(extent, &|what| println!("{what}"))?)?,
        "lightfield" => {
            // what was computed is kept beside the builds: an interrupted run goes on
            let target = std::env::var_os("CARGO_TARGET_DIR")
                .map_or_else(|| daic_tests::shared::root().join("target"), PathBuf::from);
            let folder = target.join("reproduce-lightfield");
            if extent == Extent::Full {
                std::fs::create_dir_all(&folder)
                    .map_err(|source| ReproduceError::File { path: folder.clone(), source })?;
            }
            let kept = (extent == Extent::Full).then_some(folder.as_path());
            lightfield::part(&lightfield::run(extent, kept, &|what| println!("{what}"))?)?
        }
        _ => microscopic::part(&microscopic::run(extent)?)?,
    };
    println!("{}", part.text);
    document::write(docs, &part)
}

fn main() -> ExitCode {
    let mut arguments: Vec<String> = std::env::args().skip(1).collect();
    let before = arguments.len();
    arguments.retain(|a| a != "--quick");
    let extent = if arguments.len() < before { Extent::Quick } else { Extent::Full };
    let (chapter, docs) = match arguments.as_slice() {
        [chapter] => (chapter, daic_tests::shared::root().join("docs")),
        [chapter, docs] => (chapter, PathBuf::from(docs)),
        _ => {
            eprintln!("reproduce macro|micro|lightfield [--quick] [DOCS]");
            return ExitCode::from(2);
        }
    };
    if !["macro", "micro", "lightfield"].contains(&chapter.as_str()) {
        eprintln!("reproduce: no chapter `{chapter}`: macro, micro or lightfield");
        return ExitCode::from(2);
    }
    match run(chapter, extent, &docs) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("reproduce: {error}");
            ExitCode::FAILURE
        }
    }
}
