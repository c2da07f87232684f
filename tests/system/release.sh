#!/usr/bin/env bash
# Make a release of the version in sierra/util/version.py: check everything, build, run the demo, and make the tag.
# It pushes and uploads nothing; the last lines say how.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."

fail() {
    printf 'release: %s\n' "$1" >&2
    exit "${2:-1}"
}

commit=$(git rev-parse HEAD)
changes=$(git status --porcelain)
tags=$(git tag --list)
version=$(sed -n 's/^__version__ = "\(.*\)"$/\1/p' sierra/util/version.py)
tag=v$version
today=$(date -u +%F)
[[ $version =~ ^[0-9]+\.[0-9]+\.[0-9]+$ ]] || fail "sierra/util/version.py: $version is no version such as 0.1.0" 2
[[ -z $changes ]] || fail "the working tree has changes; commit them first" 2
! grep -qx "$tag" <<<"$tags" || fail "there is a tag $tag; raise the version in sierra/util/version.py" 2
grep -qx "version: $version" CITATION.cff || fail "CITATION.cff has another version than $version" 2
grep -qx "date-released: $today" CITATION.cff || fail "CITATION.cff needs the line: date-released: $today" 2
grep -qx "## \[$version\] - $today" CHANGELOG.md || fail "CHANGELOG.md needs the heading: ## [$version] - $today" 2

.ci/run
make dist
changes=$(git status --porcelain)
[[ -z $changes ]] || fail "the checks changed files: $changes"
[[ $(git rev-parse HEAD) == "$commit" ]] || fail "there is another commit than the one that was checked, $commit"
git tag --annotate "$tag" --message "SIERRA $version" "$commit"
printf '%s\n' "tagged $tag; dist/ has:" dist/* "to publish: git push origin $tag, and upload dist/"
