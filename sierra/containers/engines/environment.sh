# Sourced by the shell that is part of apptainer and of singularity-ce, last of all, in the container, before the program starts.
# What they and the image have set is forgotten, and what came as SIERRA__NAME is NAME: the program gets the environment that
# it was given, in which nothing was evaluated. (Two names of theirs are read-only, and stay: _NAME and _CONTAINER.)
if test -v APPTAINER_CONTAINER; then
    source "/.inject-apptainer-env.sh"
    __theirs__=APPTAINER
else
    source "/.inject-singularity-env.sh"
    __theirs__=SINGULARITY
fi
IFS=$'\n'
set -o noglob
__given__=$(getallenv)
for __entry__ in ${__given__}; do
    __name__=${__entry__%%=*}
    case "${__name__}" in
    SIERRA__*|"${__theirs__}_NAME"|"${__theirs__}_CONTAINER") ;;
    *) unset "${__name__}" ;;
    esac
done
for __entry__ in ${__given__}; do
    __name__=${__entry__%%=*}
    case "${__name__}" in
    SIERRA__*) export "${__name__#SIERRA__}=${!__name__}"; unset "${__name__}" ;;
    esac
done
exec "$@"
exit 0
