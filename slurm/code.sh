# Settings for commands.
# shellcheck shell=bash

# A setting whose value may hold anything: setting NAME VALUE; as override() in tangram_core/run/code.py.
setting() {
    local escaped
    escaped=$(sed -E "s/(\\\\+)('|\\$\\{|\$)/\\1\\1\\2/g; s/'|\\$\\{/\\\\&/g" <<<"$2")
    printf "%s='%s'" "$1" "$escaped"
}

# Which settings of a master its workers must be told, too: code is loaded only where a command line
# names it.
code=() # of one's own

code_of() { # SETTING...
    local setting
    for setting in "$@"; do
        case $setting in
            task=*.py:* | task.kind=*.py:* | agent=*.py:* | agent.kind=*.py:*) code+=("$setting") ;;
            *.imports=* | reward.name=*) code+=("$setting") ;;
        esac
    done
}
