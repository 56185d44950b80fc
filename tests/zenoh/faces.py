"""One request in Protocol Buffers or in JSON, written and read field by field."""

import base64
import json

import zenoh
from google.protobuf.descriptor import FieldDescriptor

PREFIX = "wayfold/v1"
EXACT = 2**53
INTEGERS = (
    FieldDescriptor.CPPTYPE_INT32,
    FieldDescriptor.CPPTYPE_INT64,
    FieldDescriptor.CPPTYPE_UINT32,
    FieldDescriptor.CPPTYPE_UINT64,
)


class Refused(Exception):
    """A refusal: its code and its reason."""

    def __init__(self, code: int, reason: str, message: str):
        super().__init__(f"{code} {reason}: {message}")
        self.code, self.reason = code, reason


def connect(locator: str) -> zenoh.Session:
    """A session whose only peer is the server at `locator`."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([locator]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def only(session: zenoh.Session, key: str, **arguments):
    """The one reply to a query."""
    replies = list(session.get(f"{PREFIX}/{key}", timeout=60.0, **arguments))
    if len(replies) != 1:
        raise AssertionError(f"{len(replies)} replies to {key}")
    return replies[0]


class Protobuf:
    """Sends the encoded messages."""

    name = "protobuf"
    events = "events"

    def __init__(self, session: zenoh.Session, status):
        self.session, self.status = session, status

    def ask(self, key: str, request, answer):
        """The answer to a request, which is a message of the type `answer`."""
        reply = only(
            self.session, key, payload=request.SerializeToString(), encoding=zenoh.Encoding.APPLICATION_PROTOBUF
        )
        if reply.ok is not None:
            return self.read(reply.ok, answer)
        status = self.status.FromString(reply.err.payload.to_bytes())
        reason = ""
        for detail in status.details:
            if detail.type_url.endswith("google.rpc.ErrorInfo"):
                # Its first field, whose length is one byte, is the reason.
                reason = detail.value[2 : 2 + detail.value[1]].decode()
        raise Refused(status.code, reason, status.message)

    def read(self, sample, answer):
        assert sample.encoding == zenoh.Encoding.APPLICATION_PROTOBUF, sample.encoding
        return answer.FromString(sample.payload.to_bytes())


class Json:
    """Sends JSON, and reads the answers into messages."""

    name = "json"
    events = "events/json"

    def __init__(self, session: zenoh.Session):
        self.session = session

    def ask(self, key: str, request, answer):
        """Acts like Protobuf.ask."""
        fields = to_json(request)
        # The key names the index, except in a deletion.
        if key != "delete":
            fields.pop("index_name", None)
        reply = only(self.session, key, payload=json.dumps(fields), encoding=zenoh.Encoding.APPLICATION_JSON)
        if reply.ok is not None:
            return self.read(reply.ok, answer)
        status = json.loads(reply.err.payload.to_string())
        reasons = [detail["reason"] for detail in status["details"] if "domain" in detail]
        raise Refused(status["code"], reasons[0], status["message"])

    def read(self, sample, answer):
        assert sample.encoding == zenoh.Encoding.APPLICATION_JSON, sample.encoding
        return from_json(json.loads(sample.payload.to_string()), answer())


def to_json(message):
    """A request as JSON."""
    if message.DESCRIPTOR.name == "States":
        width = len(message.coordinates) // max(message.row_count, 1)
        return [list(message.coordinates[row * width : (row + 1) * width]) for row in range(message.row_count)]
    fields = {}
    for field, value in message.ListFields():
        if field.is_repeated:
            fields[field.name] = [plain(field, element) for element in value]
        else:
            fields[field.name] = plain(field, value)
    return fields


def plain(field, value):
    if field.cpp_type == FieldDescriptor.CPPTYPE_MESSAGE:
        return to_json(value)
    if field.cpp_type == FieldDescriptor.CPPTYPE_ENUM:
        return field.enum_type.values_by_number[value].name.removeprefix(prefix(field.enum_type.name))
    if field.type == FieldDescriptor.TYPE_BYTES:
        return base64.b64encode(value).decode()
    return str(value) if field.cpp_type in INTEGERS and value >= EXACT else value


def prefix(enumeration: str) -> str:
    """ON_CONFLICT_ of OnConflict."""
    letters = ("_" + letter if letter.isupper() else letter for letter in enumeration)
    return "".join(letters).lstrip("_").upper() + "_"


def from_json(fields, message):
    """An answer in JSON, as the message."""
    kind = message.DESCRIPTOR.name
    if kind == "States":
        message.row_count = len(fields)
        message.coordinates.extend(number for row in fields for number in row)
        return message
    if kind in ("KnnResponse", "QueryResponse"):
        columns = {field.name for field in message.DESCRIPTOR.fields_by_name["neighbors"].message_type.fields}
        neighbors = {name: fields.pop(name) for name in list(fields) if name in columns}
        fields["neighbors"] = neighbors
    if kind == "Neighbors":
        message.neighbor_counts.extend(len(row) for row in fields["ids"])
        # The result of each state is a row.
        fields = {name: [value for row in rows for value in row] for name, rows in fields.items()}
    for name, value in fields.items():
        field = message.DESCRIPTOR.fields_by_name[name]
        if field.cpp_type == FieldDescriptor.CPPTYPE_MESSAGE:
            if field.is_repeated:
                for element in value:
                    from_json(element, getattr(message, name).add())
            else:
                getattr(message, name).SetInParent()
                from_json(value, getattr(message, name))
        elif field.is_repeated:
            getattr(message, name).extend(read(field, element) for element in value)
        else:
            setattr(message, name, read(field, value))
    return message


def read(field, value):
    if field.cpp_type == FieldDescriptor.CPPTYPE_ENUM:
        return field.enum_type.values_by_name[prefix(field.enum_type.name) + value].number
    if field.type == FieldDescriptor.TYPE_BYTES:
        return base64.b64decode(value)
    if field.cpp_type in INTEGERS:
        assert isinstance(value, str) == (int(value) >= EXACT), value
        return int(value)
    return float(value) if field.cpp_type == FieldDescriptor.CPPTYPE_DOUBLE else value
