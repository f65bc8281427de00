"""A scene becomes echoes, echoes become frames."""
