"""A scene live in a browser: the organ in a process of its own at haptic rate, its picture and a hand beside it."""
