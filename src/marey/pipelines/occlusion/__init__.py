"""Things of the room that hide the person in single cameras."""
