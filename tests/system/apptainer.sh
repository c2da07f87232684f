#!/bin/sh
# Install apptainer on Debian 12, for tests only: Debian 12 has no such package. Needs root.
#
# Debian unstable has a package that needs a newer C library only for two names, which are aliases of older ones. This script
# fetches the package through apt with a separate index, so that signatures are checked and nothing else of the machine changes.
# Then it replaces the two names by the older ones (lower_glibc.py, which refuses any other change), and rebuilds and installs
# the package.
set -eu
here=$(cd "$(dirname "$0")" && pwd)

if command -v apptainer >/dev/null; then
	echo "$(apptainer --version) is installed"
	exit 0
fi
for program in apt-get dpkg-deb python3; do
	command -v "$program" >/dev/null || { echo "apptainer.sh: $program is missing: this script needs Debian" >&2; exit 3; }
done
test "$(id -u)" -eq 0 || { echo "apptainer.sh: only root can install packages" >&2; exit 3; }

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
mkdir -p "$work/lists/partial" "$work/cache/archives/partial" "$work/empty" "$work/sources"
: >"$work/status"
archive=$(sed -n 's/^URIs: *\([^ ]*\).*/\1/p' /etc/apt/sources.list.d/debian.sources 2>/dev/null | head -n 1)
test -n "$archive" || { echo "apptainer: debian.sources names no archive of Debian" >&2; exit 1; }
cat >"$work/sources/unstable.sources" <<END
Types: deb
URIs: $archive
Suites: unstable
Components: main
Check-Valid-Until: no
Signed-By: /usr/share/keyrings/debian-archive-keyring.gpg
END
cat >"$work/apt.conf" <<END
Dir::State::lists "$work/lists";
Dir::State::status "$work/status";
Dir::Cache "$work/cache";
Dir::Etc::sourcelist "/dev/null";
Dir::Etc::sourceparts "$work/sources";
Dir::Etc::preferencesparts "$work/empty";
APT::Sandbox::User "root";
END
APT_CONFIG="$work/apt.conf" apt-get -qq update
(cd "$work" && APT_CONFIG="$work/apt.conf" apt-get -qq download apptainer)
dpkg-deb --raw-extract "$work"/apptainer_*.deb "$work/package"

cd "$work/package"
python3 "$here/lower_glibc.py" $(find usr -type f -exec sh -c 'head -c 4 "$1" | grep -q ELF' sh {} \; -print)
sed -i -e 's/libc6 (>= 2\.3[0-9])/libc6 (>= 2.36)/' -e 's/^Version: .*/&~sierra1/' DEBIAN/control
find . -type f ! -path './DEBIAN/*' -printf '%P\0' | sort -z | xargs -0 md5sum >DEBIAN/md5sums
dpkg-deb -Zgzip -z1 --root-owner-group --build . "$work/apptainer.deb" >/dev/null
DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=600 -qq install --no-install-recommends "$work/apptainer.deb"
apptainer --version
