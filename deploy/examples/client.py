"""A policy process without Reveille's package: each device senses in every tenth TTI, and none is woken.

    pip install eclipse-zenoh
    reveille up --policy external --policy-command "python3 client.py"
"""

import json
import os
import secrets

import zenoh

ID = secrets.token_hex(8)


def decide(request):
    if request["stage"] == "wake":  # after reports
        return {"wake": []}
    devices = range(len(request["action_mask"]))
    return {"sense": [device for device in devices if (request["tti"] + device) % 10 == 0]}


config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([os.environ["REVEILLE_CONNECT"]]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    port = session.declare_queryable(f"reveille/{os.environ['REVEILLE_RUN']}/policy/v1")
    for query in port:
        request = json.loads(query.payload.to_bytes())
        answer = {"protocol": 1, "id": ID, "key": os.environ["REVEILLE_KEY"]}
        answer |= {name: request[name] for name in ("seq", "tti", "stage")}
        if request["stage"] == "hello":
            answer |= {"name": "every tenth TTI", "form": "json"}
            query.reply(query.key_expr, json.dumps(answer), encoding=zenoh.Encoding.APPLICATION_JSON)
        elif request.get("to") == ID:
            answer |= decide(request)
            query.reply(query.key_expr, json.dumps(answer), encoding=zenoh.Encoding.APPLICATION_JSON)
        query.drop()  # ends the query, which the base station waits for
        if request["stage"] == "bye":
            break
