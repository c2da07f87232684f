#!/bin/sh
# Execute runs in the folder that `sierra run --inputs` wrote. This needs a POSIX shell and its usual tools, and no SIERRA.
#
#   sh execute.sh RUN...          execute these runs; RUN is a folder such as runs/0/3
#   sh execute.sh INDEX/COUNT     execute every COUNT-th run, beginning with number INDEX; the first number is 0
#   sh execute.sh --again ...     execute also runs that have ended before
#
# Each run is executed in its folder `output`, with its declared variables, PATH, and the devices that a scheduler has allotted.
# Its folder then has `stdout` and `stderr`, and at last `ended.json`: the exit status, the times, and the machine. A run that has
# `ended.json` is left out. The exit status is 0 if all requested runs have ended, however they did.
set -u
again=
code=0

usage() {
    echo "usage: sh execute.sh [--again] runs/EXPERIMENT/NUMBER... | INDEX/COUNT" >&2
    exit 2
}

now() {
    date +%s.%N | sed 's/[^0-9.].*//; s/\.$//'
}

fact() {
    printf %s "$1" | LC_ALL=C tr -cd 'A-Za-z0-9._+~ -' | cut -c 1-250
}

give_up() {
    echo "execute.sh: $1" >&2
    code=1
}

execute() {
    if [ -f "$1/ended.json" ] && [ -z "$again" ]; then
        return
    fi
    if [ ! -f "$1/command.sh" ]; then
        give_up "$1 has no command.sh; a run with ports, robots or programs around it must be executed in another way"
        return
    fi
    id=$(sed -n 's/^# run \([0-9a-f]*\)$/\1/p' "$1/command.sh" | head -n 1)
    rm -rf "$1/ended.json" "$1/output" "$1/home" "$1/tmp" "$1/stdout" "$1/stderr"
    if ! { mkdir "$1/output" "$1/home" "$1/tmp" && : >"$1/stdout" && : >"$1/stderr"; }; then
        give_up "cannot write to $1"
        return
    fi
    started=$(now)
    (
        folder=$(cd "$1" && pwd) && cd "$1/output" || exit 125
        exec env -i PATH="$PATH" HOME="$folder/home" TMPDIR="$folder/tmp" SIERRA_RUN_DIR="$folder" \
            ${CUDA_VISIBLE_DEVICES+"CUDA_VISIBLE_DEVICES=$CUDA_VISIBLE_DEVICES"} \
            ${HIP_VISIBLE_DEVICES+"HIP_VISIBLE_DEVICES=$HIP_VISIBLE_DEVICES"} \
            ${GPU_DEVICE_ORDINAL+"GPU_DEVICE_ORDINAL=$GPU_DEVICE_ORDINAL"} \
            ${ROCR_VISIBLE_DEVICES+"ROCR_VISIBLE_DEVICES=$ROCR_VISIBLE_DEVICES"} \
            ${NVIDIA_VISIBLE_DEVICES+"NVIDIA_VISIBLE_DEVICES=$NVIDIA_VISIBLE_DEVICES"} \
            ${ZE_AFFINITY_MASK+"ZE_AFFINITY_MASK=$ZE_AFFINITY_MASK"} \
            sh ../command.sh
    ) </dev/null >"$1/stdout" 2>"$1/stderr"
    status=$?
    ended=$(now)
    cores=$(getconf _NPROCESSORS_ONLN 2>/dev/null) || cores=
    if ! { printf '{"format": 1, "run": "%s", "status": %s, "started": %s, "ended": %s, "host": "%s", "system": "%s", ' \
        "$id" "$status" "$started" "$ended" "$(fact "$(uname -n)")" "$(fact "$(uname -s)")" &&
        printf '"release": "%s", "machine": "%s", "cores": %s}\n' \
            "$(fact "$(uname -r)")" "$(fact "$(uname -m)")" "${cores:-null}"; } >"$1/.ended.$$" ||
        ! mv -f "$1/.ended.$$" "$1/ended.json"; then
        give_up "cannot write to $1"
    fi
}

if [ "${1-}" = --again ]; then
    again=yes
    shift
fi
[ $# -gt 0 ] || usage
cd -- "$(dirname -- "$0")" || exit 1
case $1 in
*[!0-9/]* | */*/* | /* | */ | 0[0-9]* | */0*) ;;
*/*)
    [ $# -eq 1 ] && [ "${1%/*}" -lt "${1#*/}" ] || usage
    next=${1%/*}
    number=0
    for run in runs/*/*/; do
        if [ "$number" -eq "$next" ]; then
            execute "${run%/}"
            next=$((next + ${1#*/}))
        fi
        number=$((number + 1))
    done
    exit "$code"
    ;;
esac
for run; do
    run=${run#./}
    run=${run%/}
    case $run in
    *..* | runs/*/*/*) usage ;;
    runs/[0-9]*/[0-9]*) [ -d "$run" ] || usage ;;
    *) usage ;;
    esac
    execute "$run"
done
exit "$code"
