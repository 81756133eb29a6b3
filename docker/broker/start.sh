#!/bin/sh
# Makes the broker's password file from the secrets, and starts the broker.
set -eu
umask 077
published='' passwords=/tmp/passwords
rm -f "$passwords"
for user in plant control_plc optimizer_plc operator; do
    password=$(cat "/run/secrets/mqtt_$user")
    case $password in test-site-*) published=$user ;; esac
    printf '%s:%s\n' "$user" "$password" >>"$passwords"
done
if [ -n "$published" ]; then # anybody can read it in the project's repository
    case $PUBLISHED_ON in
        127.* | localhost | ::1 | '[::1]') echo "warning: the password of $published is the one that comes with the project" >&2 ;;
        *)
            echo "error: the password of $published is the one that comes with the project, and ports are published on" \
                "$PUBLISHED_ON: choose passwords of your own, and name their folder in COLDLOOP_PASSWORDS" >&2
            exit 1
            ;;
    esac
fi
mosquitto_passwd -U "$passwords"
exec mosquitto -c /mosquitto/config/mosquitto.conf
