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
#
# A run that another process executes is left out, too: there is a folder such as `runs/0/.3.running` meanwhile.
set -u
again=
code=0
lock=
trap 'unlock' EXIT
trap 'exit 129' HUP
trap 'exit 130' INT
trap 'exit 143' TERM

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

unlock() {
    if [ -n "$lock" ]; then
        rm -rf "$lock"
        lock=
    fi
}

# Lock a run: make the folder `$2`. One that a killed process of this machine has left is taken over.
lock() {
    if mkdir "$2" 2>/dev/null; then
        lock=$2
    elif [ ! -d "$2" ]; then
        give_up "cannot write to ${1%/*}"
        return 1
    elif is_left "$2" && mkdir "$2/taken" 2>/dev/null; then
        if is_left "$2"; then
            lock=$2
        else
            rmdir "$2/taken"
        fi
    fi
    if [ -z "$lock" ]; then
        give_up "$1: $(cat "$2/owner" 2>/dev/null || echo another process) executes it; if nothing does any more, remove $2"
        return 1
    fi
    if ! echo "process $$ on $(uname -n)" >"$lock/owner"; then
        give_up "cannot write to ${1%/*}"
        unlock
        return 1
    fi
    [ ! -d "$lock/taken" ] || rmdir "$lock/taken"
}

# Check that the process that has made a lock is gone. Only its own machine can tell.
is_left() {
    owner=$(cat "$1/owner" 2>/dev/null) || return 1
    case $owner in
    "process "[1-9]*" on $(uname -n)") ;;
    *) return 1 ;;
    esac
    pid=${owner#process }
    pid=${pid%% *}
    [ "$pid" = $$ ] || { ! kill -0 "$pid" 2>/dev/null && [ ! -d "/proc/$pid" ]; }
}

execute() {
    if [ -f "$1/ended.json" ] && [ -z "$again" ]; then
        return
    fi
    lock "$1" "${1%/*}/.${1##*/}.running" || return 0
    execute_locked "$1"
    unlock
}

execute_locked() {
    if [ -f "$1/ended.json" ] && [ -z "$again" ]; then
        return
    fi
    if [ ! -f "$1/command.sh" ]; then
        give_up "$1 has no command.sh; a run with ports, a checkpoint, robots or programs around it must be executed in another way"
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
