#!/usr/bin/env bash
# Provides a rustc that can build for bare-metal Arm and prints the environment needed to use it:
#
#   eval "$(ci/thumb-toolchain.sh)" && cargo build --target thumbv6m-none-eabi -p daic-firmware
#
# A target already installed in rustup (`rustup target add thumbv6m-none-eabi`, your choice, never
# done from here) is used as it is. Otherwise Debian's rustc-web is unpacked in a private prefix (no
# root, nothing installed system-wide), and core and alloc are built once from the matching sources
# and laid out as an ordinary sysroot, so that no -Z flag is needed afterwards.
#
# THUMB_TARGETS, THUMB_PREFIX: what to build for, where to keep it (default: target/thumb).
# THUMB_ROUTE=debian leaves rustup's target aside.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
read -r -a TARGETS <<<"${THUMB_TARGETS:-thumbv6m-none-eabi}"
PREFIX=${THUMB_PREFIX:-$here/target/thumb}
log() { echo "thumb-toolchain: $*" >&2; }
have_all() {
  local installed t
  installed=$(rustup target list --installed 2>/dev/null) || return 1
  for t in "${TARGETS[@]}"; do grep -qx "$t" <<<"$installed" || return 1; done
}

if [ "${THUMB_ROUTE:-}" != debian ] && have_all; then log "rustup has ${TARGETS[*]}"; exit 0; fi

SYS=$PREFIX/usr; LIB=$SYS/lib/rustlib; HOST=x86_64-unknown-linux-gnu
emit() { printf 'export RUSTC=%q RUSTDOC=%q\nunset RUSTC_BOOTSTRAP\n' "$PREFIX/bin/rustc" "$PREFIX/bin/rustdoc"; }
done_mark="$PREFIX/.done-${TARGETS[*]// /_}"
if [ -e "$done_mark" ] && "$PREFIX/bin/rustc" -V >/dev/null 2>&1; then log "cached in $PREFIX"; emit; exit 0; fi

[ "$(uname -m)" = x86_64 ] || { log "the Debian route is written for x86-64; install the target with rustup"; exit 1; }
command -v apt-get >/dev/null && command -v dpkg-deb >/dev/null || { log "neither rustup target nor apt-get: install the target with rustup"; exit 1; }
log "Debian route into $PREFIX"
mkdir -p "$PREFIX/debs" "$PREFIX/bin"; cd "$PREFIX/debs"
APT=()
if [ -z "$(apt-cache policy rustc-web 2>/dev/null | sed -n 's/ *Candidate: //p')" ]; then
  # package lists of our own, so that neither root nor the system's lists are needed
  mkdir -p "$PREFIX/lists/partial"
  APT=(-o "Dir::State::lists=$PREFIX/lists" -o "Dir::Cache::pkgcache=" -o "Dir::Cache::srcpkgcache=" -o Debug::NoLocking=1)
  apt-get "${APT[@]}" -qq update >&2
fi
if [ ! -x "$SYS/bin/rustc" ]; then
  # rust-web-src must be exactly rustc-web's version: core does not build with any other
  V=$(apt-cache "${APT[@]}" policy rustc-web | sed -n 's/ *Candidate: //p')
  N=$(apt-cache "${APT[@]}" depends "libstd-rust-web-dev=$V" | sed -n 's/.*Depends: \(libstd-rust-web-[0-9.]*\)$/\1/p' | head -1)
  L=$(apt-cache "${APT[@]}" depends "$N=$V" | sed -n 's/.*Depends: \(libllvm[0-9]*\)$/\1/p' | head -1)
  apt-get "${APT[@]}" download -q "rustc-web=$V" "$N=$V" "libstd-rust-web-dev=$V" "rust-web-src=$V" "$L" >&2
  for d in *.deb; do
    case $d in
      rust-web-src*) dpkg-deb --fsys-tarfile "$d" | tar -x -C "$PREFIX" --wildcards './usr/src/*/library' './usr/lib/*' ;;
      *) dpkg-deb -x "$d" "$PREFIX" ;;
    esac
  done
  rm -f ./*.deb
fi
for b in rustc rustdoc; do
  printf '#!/bin/sh\nLD_LIBRARY_PATH=%q${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH} exec %q "$@"\n' \
    "$SYS/lib/x86_64-linux-gnu" "$SYS/bin/$b" > "$PREFIX/bin/$b"
  chmod +x "$PREFIX/bin/$b"
done
# rustc asks for "rust-lld" in its own sysroot: rustup's serves, else Debian's lld
mkdir -p "$LIB/$HOST/bin"
lld=$(rustc --print sysroot 2>/dev/null)/lib/rustlib/$HOST/bin/rust-lld
[ -x "$lld" ] || lld=$(command -v lld || true)
[ -n "$lld" ] || { log "no rust-lld and no lld"; exit 1; }
ln -sf "$lld" "$LIB/$HOST/bin/rust-lld"
W=$PREFIX/build-std; mkdir -p "$W/src"
printf '[package]\nname="s"\nversion="0.0.0"\nedition="2021"\n[profile.release]\nopt-level=3\n[workspace]\n' > "$W/Cargo.toml"
echo '#![no_std]' > "$W/src/lib.rs"
for t in "${TARGETS[@]}"; do
  [ -e "$LIB/$t/lib/.ok" ] && continue
  # bitcode embedded: without it fat LTO of a firmware image fails
  (cd "$W" && env -u CARGO_BUILD_TARGET RUSTC="$PREFIX/bin/rustc" RUSTC_BOOTSTRAP=1 RUSTFLAGS="-Cembed-bitcode=yes" \
     CARGO_TARGET_DIR="$W/target" cargo build -q --release -Zbuild-std=core,alloc --target "$t" >&2)
  rm -rf "$LIB/$t"; mkdir -p "$LIB/$t/lib"
  for f in "$W/target/$t/release/deps"/lib*.rlib; do
    case ${f##*/} in libs-*) ;; *) cp "$f" "$LIB/$t/lib/" ;; esac
  done
  touch "$LIB/$t/lib/.ok"
done
rm -rf "$W/target"
touch "$done_mark"
emit
