#!/bin/sh
# Runs targets of the Makefile in a bare Debian, as a newcomer would: tools/bare_root.sh trixie demo test
# Needs root and debootstrap. What is committed is run; the root stays in .build/roots.
set -eu

suite=$1
shift
cd "$(dirname "$0")/.."
root=$PWD/.build/roots/$suite
[ "$(id -u)" = 0 ] || { echo "bare_root: only root can make a root: sudo make bare-root" >&2; exit 1; }
command -v debootstrap >/dev/null || { echo "bare_root: apt-get install debootstrap" >&2; exit 1; }

if [ ! -e "$root/etc/debian_version" ]; then
    mkdir -p "$root"
    debootstrap --variant=minbase --include=ca-certificates,make "$suite" "$root"
fi
# The network as this machine has it: its resolver, and whom it trusts.
cp -L /etc/resolv.conf "$root/etc/resolv.conf"
cp -L /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/ca-certificates.crt"
rm -rf "$root/relpos"
mkdir "$root/relpos"
git archive HEAD | tar -x -C "$root/relpos"

mkdir -p "$root/dev/pts" "$root/dev/shm"
ln -sf pts/ptmx "$root/dev/ptmx"
trap 'umount "$root/dev/shm" "$root/dev/pts" "$root/proc"' EXIT
mount -t proc proc "$root/proc"
mount -t devpts devpts "$root/dev/pts" -o newinstance,ptmxmode=0666
mount -t tmpfs shm "$root/dev/shm"
for target; do
    echo "== $suite: make $target"
    chroot "$root" env -i HOME=/root LANG=C.UTF-8 PATH=/usr/sbin:/usr/bin:/sbin:/bin TERM=dumb \
        $(env | grep -E '^(PIP_|https?_proxy=|HTTPS?_PROXY=|RELPOS_)' | grep -v ' ') \
        make -C /relpos "$target"
done
