# Which settings of a master its workers must be told, too: code is loaded only where a command line
# names it.
# shellcheck shell=bash

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
