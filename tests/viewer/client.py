"""A viewer: subscribes to all channels of a server, and prints what it received and decoded as JSON.

usage: client.py ADDRESS TOPIC...     ends when each topic has a message
"""

import asyncio
import base64
import json
import struct
import sys

import websockets
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory


def decoder(channel):
    """The function that decodes messages of a channel by its schema."""
    if channel["encoding"] == "json":
        return json.loads
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    waiting = {file.name: file for file in files.file}

    def add(name):
        file = waiting.pop(name, None)
        if file is not None:
            for dependency in file.dependency:
                add(dependency)
            pool.Add(file)

    for file in files.file:
        add(file.name)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"])).FromString


def described(topic, message):
    """What the test looks at."""
    if topic == "/scan":
        return {"points": len(message.data) // message.point_stride, "frame": message.frame_id}
    if topic == "/map":
        return {"models": [len(it.data) for entity in message.entities for it in entity.models]}
    if topic == "/estimate":
        return {"x": message.pose.position.x, "covariance": list(message.pose_covariance)}
    if topic == "/tf":
        return {"parent": message.parent_frame_id, "child": message.child_frame_id}
    if topic == "/particles":
        return {"poses": len(message.poses)}
    if topic == "/state":
        return {"message": message.message}
    return message


async def main(address, topics):
    async with websockets.connect(
        f"ws://{address}", subprotocols=["foxglove.sdk.v1"], max_size=None
    ) as socket:
        channels, decoders, received = {}, {}, {}
        while not set(received) >= set(topics):
            frame = await socket.recv()
            if isinstance(frame, str):
                for channel in json.loads(frame).get("channels", []):
                    channels[channel["id"]] = channel
                    decoders[channel["id"]] = decoder(channel)
                    subscription = {"id": channel["id"], "channelId": channel["id"]}
                    await socket.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))
            elif frame[0] == 1:
                subscription, _time_ns = struct.unpack_from("<IQ", frame, 1)
                topic = channels[subscription]["topic"]
                received[topic] = described(topic, decoders[subscription](frame[13:]))
        print(json.dumps(received))


asyncio.run(main(sys.argv[1], sys.argv[2:]))
