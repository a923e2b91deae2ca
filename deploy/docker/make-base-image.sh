#!/bin/sh
# Makes a small Debian base image with debootstrap, for machines that cannot pull one.
#
# usage: make-base-image.sh [--force] [--mirror URL] [--ca FILE] [TAG [SUITE]]
#
#   TAG          image to make                    (default: reveille-base:local)
#   SUITE        Debian release                   (default: bookworm)
#   --force      make it again even if TAG exists
#   --mirror URL Debian mirror; without it the one apt uses on this host for SUITE
#   --ca FILE    extra CA bundle for an https mirror; without it apt's Acquire::https::CAInfo
#
# Run as root (debootstrap makes device nodes and a chroot). Nothing is installed on the host.
# Debian packages it needs there: debootstrap, debian-archive-keyring, wget, docker.io.
# Proxies: http_proxy, https_proxy and no_proxy, or else the proxy in apt's configuration.
set -eu

say() { printf 'make-base-image: %s\n' "$*"; }
die() {
    say "$*" >&2
    exit 1
}
usage() { sed -n '2,/^set -eu$/{/^#/s/^# \{0,1\}//p;}' "$0"; }
# A mirror's user name and password belong neither in a log nor in the image.
without_login() { sed 's#//[^/@]*@#//#'; }

# Prints "URI SUITE" for every enabled http(s) binary source in apt's one-line and deb822 files.
apt_sources() {
    for file in /etc/apt/sources.list /etc/apt/sources.list.d/*.list; do
        [ -r "$file" ] || continue
        sed -n 's/#.*//; s/\[[^]]*\]//; s/^[[:space:]]*deb[[:space:]]\{1,\}//p' "$file" |
            awk '$1 ~ /^https?:/ { print $1, $2 }'
    done
    for file in /etc/apt/sources.list.d/*.sources; do
        [ -r "$file" ] || continue
        awk '
            function flush(   u, s, i, j, n, m) {
                if (types ~ /(^| )deb( |$)/ && enabled !~ /^(no|false|0|off|without|disable)$/) {
                    n = split(uris, u, " "); m = split(suites, s, " ")
                    for (i = 1; i <= n; i++) for (j = 1; j <= m; j++)
                        if (u[i] ~ /^https?:/) print u[i], s[j]
                }
                types = uris = suites = enabled = field = ""
            }
            function take(text) {
                gsub(/[ \t\r]+/, " ", text); sub(/^ /, "", text); sub(/ $/, "", text)
                if (field == "types") types = types " " text
                if (field == "uris") uris = uris " " text
                if (field == "suites") suites = suites " " text
                if (field == "enabled") enabled = tolower(text)
            }
            /^#/ { next }
            /^[ \t]*$/ { flush(); next }
            /^[ \t]/ { take($0); next }
            { field = tolower($0); sub(/:.*/, "", field); text = $0; sub(/^[^:]*:/, "", text); take(text) }
            END { flush() }
        ' "$file"
    done
}

# Prefers the host's mirror for the suite, then any Debian mirror of the host, then Debian's own.
host_mirror() {
    apt_sources | awk -v suite="$1" '
        $2 == suite && exact == "" { exact = $1 }
        $1 ~ /\/debian\/?$/ && any == "" { any = $1 }
        END { print exact != "" ? exact : any != "" ? any : "http://deb.debian.org/debian" }'
}

apt_setting() {
    if command -v apt-config >/dev/null 2>&1; then
        (
            value=
            eval "$(apt-config shell value "$1")"
            printf '%s' "$value"
        )
    fi
}

force=no
mirror=
ca=
while [ $# -gt 0 ]; do
    case $1 in
    --force) force=yes ;;
    --mirror | --ca)
        [ $# -ge 2 ] || die "$1 needs a value"
        if [ "$1" = --mirror ]; then mirror=$2; else ca=$2; fi
        shift
        ;;
    -h | --help)
        usage
        exit 0
        ;;
    -*) die "unknown option $1 (see --help)" ;;
    *) break ;;
    esac
    shift
done
[ $# -le 2 ] || die "too many arguments (see --help)"
tag=${1:-reveille-base:local}
suite=${2:-bookworm}

command -v docker >/dev/null 2>&1 || die "docker is missing: install docker.io"
docker info >/dev/null 2>&1 || die "the docker engine does not answer"
if [ "$force" = no ] && docker image inspect "$tag" >/dev/null 2>&1; then
    say "$tag exists; --force makes it again"
    exit 0
fi

for tool in debootstrap wget; do
    command -v "$tool" >/dev/null 2>&1 || die "$tool is missing: apt-get install debootstrap debian-archive-keyring wget"
done
keyring=/usr/share/keyrings/debian-archive-keyring.gpg
[ -r "$keyring" ] || die "$keyring is missing: apt-get install debian-archive-keyring"
[ "$(id -u)" = 0 ] || die "debootstrap needs root: run this script as root"

[ -n "$mirror" ] || mirror=$(host_mirror "$suite")
if [ -z "${http_proxy:-}" ]; then
    http_proxy=$(apt_setting Acquire::http::Proxy)
    [ -z "$http_proxy" ] || [ "$http_proxy" = DIRECT ] || export http_proxy
fi
if [ -z "${https_proxy:-}" ]; then
    https_proxy=$(apt_setting Acquire::https::Proxy)
    [ -z "$https_proxy" ] || [ "$https_proxy" = DIRECT ] || export https_proxy
fi
[ -n "$ca" ] || ca=$(apt_setting Acquire::https::CAInfo)
[ -z "$ca" ] || [ -r "$ca" ] || die "cannot read the CA bundle $ca"

work=$(mktemp -d)
root=$work/root

# Runs on every exit. A killed debootstrap leaves /proc mounted in the chroot: the script deletes nothing while a mount
# remains there, and the deletion never crosses a mount.
cleanup() {
    awk -v under="$work/" 'index($2, under) == 1 { print $2 }' /proc/mounts | sort -r |
        while read -r mounted; do umount "$mounted" || umount -l "$mounted" || true; done
    if grep -qF " $work/" /proc/mounts; then
        say "something is still mounted under $work; left in place" >&2
    else
        rm -rf --one-file-system "$work"
    fi
}
trap cleanup EXIT
trap 'exit 130' INT
trap 'exit 143' TERM HUP

if [ -n "$ca" ]; then
    printf 'ca_certificate = %s\n' "$ca" >"$work/wgetrc"
    export WGETRC="$work/wgetrc"
fi

say "debootstrap $suite from $(printf '%s' "$mirror" | without_login) ..."
start=$(date +%s)
if ! debootstrap --variant=minbase --force-check-gpg --keyring="$keyring" \
    "$suite" "$root" "$mirror" >"$work/log" 2>&1; then
    without_login <"$work/log" | tail -n 20 >&2
    [ ! -r "$root/debootstrap/debootstrap.log" ] ||
        without_login <"$root/debootstrap/debootstrap.log" | tail -n 20 >&2
    die "debootstrap failed"
fi

printf 'deb %s %s main\n' "$(printf '%s' "$mirror" | without_login)" "$suite" >"$root/etc/apt/sources.list"
# Licence files stay: an image is a distribution of these packages.
find "$root/usr/share/doc" -type f ! -name copyright -delete
find "$root/var/log" -type f -delete
rm -rf "$root"/usr/share/man/* "$root"/usr/share/info/* "$root"/usr/share/locale/* \
    "$root"/var/cache/apt/* "$root"/var/lib/apt/lists/* "$root"/var/cache/debconf/*-old \
    "$root"/etc/machine-id "$root"/etc/hostname "$root"/etc/resolv.conf

tar --numeric-owner --one-file-system --sort=name -C "$root" \
    --exclude='./dev/*' --exclude='./proc/*' --exclude='./sys/*' -cf "$work/root.tar" .
docker import --change 'CMD ["bash"]' \
    --change "LABEL org.opencontainers.image.title=reveille-base" \
    --change "LABEL org.opencontainers.image.description=Debian-$suite-minbase" \
    "$work/root.tar" "$tag" >/dev/null
size=$(docker image inspect --format '{{.Size}}' "$tag")
say "made $tag: $((size / 1000000)) MB in $(($(date +%s) - start)) s"
